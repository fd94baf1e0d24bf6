"""DeepFloyd IF's guidance: pixels, six output channels, T5 embeddings; its gradient against
float64.
"""

import pytest
import torch

from tests.helpers import tiny_guidance, tiny_models
from tests.helpers import tiny_large_guidance as tiny
from tests.helpers.tiny_guidance import BATCH, renders

pytest.importorskip("diffusers")
KIND = "deep-floyd"


@pytest.fixture(scope="module")
def model(tmp_path_factory):
    return tiny_models.deep_floyd(tmp_path_factory.mktemp("models") / "if")


@pytest.fixture(scope="module")
def prompts(model):
    return tiny.prompts(KIND, model)


def reference_gradient(model, prompt_utils, rgb, *, scale):
    from diffusers import DDPMScheduler, UNet2DConditionModel

    unet = tiny_guidance.in_double(UNet2DConditionModel, model, "unet")
    betas = DDPMScheduler.from_pretrained(model, subfolder="scheduler").betas.double()
    text = prompt_utils.get_text_embeddings(**BATCH).double()
    return tiny_guidance.reference_gradient(
        rgb,
        lambda z, t, row: unet(z, t, encoder_hidden_states=text[row]).sample[:, :3],
        lambda image, generator: image * 2 - 1,
        tiny_guidance.diffusion_path(torch.cumprod(1 - betas, 0)),
        scale=scale,
    )


def test_the_gradient_is_that_of_a_float64_reference(model, prompts):
    rgb = renders(size=16)
    mine, _ = tiny.gradient(tiny.guidance(KIND, model), prompts, rgb)
    expected = reference_gradient(model, prompts, rgb, scale=20.0)
    # float32, magnified twentyfold by the guidance
    assert (mine - expected).norm() / expected.norm() < 1e-5


def test_the_variance_that_the_unet_also_predicts_is_left_out(model):
    guide, rgb = tiny.guidance(KIND, model), renders(size=16)
    prompts = tiny.prompts(KIND, model, use_perp_neg=True)
    before, _ = tiny.gradient(guide, prompts, rgb)
    with torch.no_grad():
        guide.unet.conv_out.weight[3:] += 1.0
    assert torch.equal(before, tiny.gradient(guide, prompts, rgb)[0])


def test_the_render_is_seen_at_the_models_size(model, prompts):
    guide = tiny.guidance(KIND, model)
    assert guide.text_width == tiny_models.TEXT_WIDTH  # of T5, not of the cross-attention
    rgb = renders(size=128)
    mine, out = tiny.gradient(guide, prompts, rgb)
    assert guide.encode(rgb.movedim(-1, 1)).shape == (4, 3, 16, 16)
    assert (mine != 0).all(), "a pixel that the model doesn't see is never trained"
    larger = tiny.guidance(KIND, model, image_size=32)
    assert larger.encode(rgb.movedim(-1, 1)).shape == (4, 3, 32, 32)


def test_the_schedule_is_the_models_to_its_last_step(model):
    """IF's cosine schedule ends at 2.4e-9, below the value that replaces a signal of exactly 0."""
    from diffusers import DDPMScheduler

    expected = DDPMScheduler.from_pretrained(model, subfolder="scheduler").alphas_cumprod.double()
    found = tiny.guidance(KIND, model).alphas_cumprod
    assert found[-1] < 1e-8
    torch.testing.assert_close(found, expected, rtol=1e-3, atol=0)
