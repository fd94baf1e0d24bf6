"""The memory of published models, computed without weights."""

import pytest
import torch

from benchmarks.markdown import read
from benchmarks.models import memory
from benchmarks.models.published import MODELS

diffusers = pytest.importorskip("diffusers")
CAMERA_EMBEDDING = (16 + 1) * 1280 + (1280 + 1) * 1280


def test_the_committed_counts_are_those_of_the_networks():
    rows = {row["model"]: int(row["network_parameters"]) for row in read(memory.RESULTS)}
    assert list(rows) == list(MODELS)
    assert rows["Stable Diffusion XL"] == 2_567_463_684  # that of the published file
    # MVDream is Stable Diffusion 2.1 with an embedding of cameras
    assert rows["MVDream"] == rows["Stable Diffusion 2.1"] + CAMERA_EMBEDDING
    assert memory.parameters(memory.network_of(MODELS["MVDream"])) == rows["MVDream"]


def test_the_gradients_bytes_are_those_of_a_real_pass():
    sizes = {"block_out_channels": (8, 16), "norm_num_groups": 4, "latent_channels": 4}
    blocks = {
        "down_block_types": ("DownEncoderBlock2D",) * 2,
        "up_block_types": ("UpDecoderBlock2D",) * 2,
    }
    vae = diffusers.AutoencoderKL(**sizes, **blocks).requires_grad_(False)
    own = {parameter.untyped_storage().data_ptr() for parameter in vae.parameters()}
    kept = {}
    image = torch.zeros(1, 3, 32, 32, requires_grad=True)

    def pack(tensor):
        kept[tensor.untyped_storage().data_ptr()] = tensor
        return tensor

    with torch.autograd.graph.saved_tensors_hooks(pack, lambda tensor: tensor):
        vae.encode(image)
    real = sum(
        tensor.untyped_storage().nbytes() for place, tensor in kept.items() if place not in own
    )
    with torch.device("meta"):
        unloaded = diffusers.AutoencoderKL(**sizes, **blocks)
    # the CPU's kernel of attention keeps one more number per token
    assert 0.97 * real < memory.gradient_bytes(unloaded, 32, 4) <= real
    assert memory.gradient_bytes(unloaded, 32, 2) == memory.gradient_bytes(unloaded, 32, 4) // 2
