"""Stable Diffusion XL's guidance: two text encoders, pooled embedding and sizes; its gradient
against float64 and in closed form.
"""

import pytest
import torch

from tests.helpers import tiny_large_guidance as tiny
from tests.helpers import tiny_large_models, tiny_models
from tests.helpers.tiny_guidance import (
    Recorder,
    diffusion_path,
    in_double,
    posterior_sample,
    relative,
    renders,
)
from tests.helpers.tiny_guidance import reference_gradient as in_float64
from threestudio_gaussiandreamer.core.errors import UserError
from threestudio_gaussiandreamer.guidance import text_to_image
from threestudio_gaussiandreamer.models.text_encoders import unpack

pytest.importorskip("diffusers")
KIND = "stable-diffusion-xl"
POOLED = tiny_large_models.POOLED


@pytest.fixture
def prompts(large):
    return large(KIND)[1]


def reference_gradient(model, prompt_utils, rgb, *, scale):
    from diffusers import AutoencoderKL, DDPMScheduler, UNet2DConditionModel

    unet, vae = (
        in_double(kind, model, component)
        for kind, component in ((UNet2DConditionModel, "unet"), (AutoencoderKL, "vae"))
    )
    betas = DDPMScheduler.from_pretrained(model, subfolder="scheduler").betas.double()
    batch = {name: value for name, value in tiny.views().items() if name != "c2w"}
    tokens, pooled = unpack(prompt_utils.get_text_embeddings(**batch).double(), POOLED)
    sizes = torch.tensor([[64, 64, 0, 0, 64, 64]]).double()

    def network(z, t, row):
        added = {"text_embeds": pooled[row], "time_ids": sizes}
        return unet(z, t, encoder_hidden_states=tokens[row], added_cond_kwargs=added).sample

    def encode(image, generator):
        return 0.13025 * posterior_sample(vae, image, generator)

    path = diffusion_path(torch.cumprod(1 - betas, 0))
    return in_float64(rgb, network, encode, path, scale=scale)


def test_the_gradient_is_that_of_a_float64_reference(model, prompts):
    rgb = renders()
    mine, _ = tiny.gradient(tiny.guidance(KIND, model), prompts, rgb)
    # guidance 100 magnifies the rounding of float32 a hundredfold
    assert relative(mine, reference_gradient(model, prompts, rgb, scale=100.0)) < 1e-5


def test_the_unet_gets_the_pooled_embedding_and_the_sizes(model, prompts):
    guide = tiny.guidance(KIND, model, image_size=128)
    guide.unet = recorder = Recorder(guide.unet)
    tiny.gradient(guide, prompts, renders())
    ((_, options),) = recorder.calls
    assert options["encoder_hidden_states"].shape == (8, 77, 64)
    added = options["added_cond_kwargs"]
    assert added["time_ids"].tolist() == [[128, 128, 0, 0, 128, 128]] * 8
    assert torch.equal(added["text_embeds"][4:], prompts.uncond_text_embeddings_vd[:4, -1, :POOLED])


@pytest.mark.parametrize(
    "half_type, force_upcast", [("float16", True), ("float16", False), ("bfloat16", True)]
)
def test_half_precision_and_a_vae_that_overflows(
    prompts, model, tmp_path, monkeypatch, half_type, force_upcast
):
    folder = tiny_large_models.stable_diffusion_xl(tmp_path / "xl", force_upcast=force_upcast)
    dtype = getattr(torch, half_type)
    monkeypatch.setattr(text_to_image, "weights_type", lambda *options: dtype)
    guide, rgb = tiny.guidance(KIND, folder, half_precision_type=half_type), renders()
    assert guide.unet.dtype == dtype
    stays = force_upcast and dtype == torch.float16
    assert guide.vae.dtype == (torch.float32 if stays else dtype)
    mine, out = tiny.gradient(guide, prompts, rgb)
    assert (
        mine.dtype
        == out["loss_sds"].dtype
        == guide.decode(guide.encode(rgb.movedim(-1, 1))).dtype
        == torch.float32
    )
    # bfloat16 rounds to 4e-3, which guidance 100 magnifies
    assert relative(mine, reference_gradient(folder, prompts, rgb, scale=100.0)) < 0.5


def test_other_models_are_refused_by_name(model, tmp_path):
    other = tiny_models.stable_diffusion(tmp_path / "sd")
    said = "isn't Stable Diffusion XL, but Stable Diffusion 1.x.*--config gaussiandreamer.yaml"
    for build in (tiny.guidance, tiny.prompts):
        with pytest.raises(UserError, match=said):
            build(KIND, other)
    with pytest.raises(UserError, match="isn't Stable Diffusion 1.x.*gaussiandreamer-sdxl.yaml"):
        tiny.guidance("stable-diffusion", model)
    with pytest.raises(UserError, match="64 channels.*takes 32"):
        guide = tiny.guidance("stable-diffusion", other)
        tiny.gradient(guide, tiny.prompts(KIND, model), renders())
