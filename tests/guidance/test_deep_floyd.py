"""DeepFloyd IF's guidance: pixels, six output channels, T5 embeddings; its gradient against
float64.
"""

import pytest
import torch

from tests.helpers import tiny_models

pytest.importorskip("diffusers")

from tests.helpers import tiny_guidance as tiny
from tests.helpers.tiny_guidance import BATCH
from threestudio_gaussiandreamer.host import find


@pytest.fixture(scope="module")
def model(tmp_path_factory):
    return tiny_models.deep_floyd(tmp_path_factory.mktemp("models") / "if")


@pytest.fixture(scope="module")
def prompts(model):
    options = {
        "pretrained_model_name_or_path": str(model),
        "prompt": "a fox",
        "negative_prompt": "ugly",
        "use_cache": False,
    }
    processor = find("gaussiandreamer-deep-floyd-prompt-processor")
    return {perp: processor({**options, "use_perp_neg": perp})() for perp in (False, True)}


def guidance(model, **options):
    return find("gaussiandreamer-deep-floyd-guidance")(
        {"pretrained_model_name_or_path": str(model), **options}
    )


def renders(size=16):
    return torch.rand(4, size, size, 3, generator=torch.Generator().manual_seed(0)).requires_grad_()


def gradient(guide, prompt_utils, rgb, **options):
    out = guide(rgb, prompt_utils, **BATCH, **options)
    return torch.autograd.grad(out["loss_sds"], rgb)[0], out


def reference_gradient(model, prompt_utils, rgb, *, scale):
    from diffusers import DDPMScheduler, UNet2DConditionModel

    unet = tiny.in_double(UNet2DConditionModel, model, "unet")
    betas = DDPMScheduler.from_pretrained(model, subfolder="scheduler").betas.double()
    text = prompt_utils.get_text_embeddings(**BATCH).double()
    return tiny.reference_gradient(
        rgb,
        lambda z, t, row: unet(z, t, encoder_hidden_states=text[row]).sample[:, :3],
        lambda image, generator: image * 2 - 1,
        tiny.diffusion_path(torch.cumprod(1 - betas, 0)),
        scale=scale,
    )


def test_the_gradient_is_that_of_a_float64_reference(model, prompts):
    rgb = renders()
    mine, _ = gradient(guidance(model), prompts[False], rgb)
    expected = reference_gradient(model, prompts[False], rgb, scale=20.0)
    # float32, magnified twentyfold by the guidance
    assert (mine - expected).norm() / expected.norm() < 1e-5


def test_the_variance_that_the_unet_also_predicts_is_left_out(model, prompts):
    guide, rgb = guidance(model), renders()
    before, _ = gradient(guide, prompts[True], rgb)
    with torch.no_grad():
        guide.unet.conv_out.weight[3:] += 1.0
    assert torch.equal(before, gradient(guide, prompts[True], rgb)[0])


def test_the_render_is_seen_at_the_models_size(model, prompts):
    guide = guidance(model)
    assert guide.text_width == tiny_models.TEXT_WIDTH  # of T5, not of the cross-attention
    rgb = renders(size=128)
    mine, out = gradient(guide, prompts[False], rgb)
    assert guide.encode(rgb.movedim(-1, 1)).shape == (4, 3, 16, 16)
    assert (mine != 0).all(), "a pixel that the model doesn't see is never trained"
    assert torch.isfinite(out["loss_sds"])
    assert guidance(model, image_size=32).encode(rgb.movedim(-1, 1)).shape == (4, 3, 32, 32)


def test_the_schedule_is_the_models_to_its_last_step(model):
    """IF's cosine schedule ends at 2.4e-9, below the value that replaces a signal of exactly 0."""
    from diffusers import DDPMScheduler

    expected = DDPMScheduler.from_pretrained(model, subfolder="scheduler").alphas_cumprod.double()
    found = guidance(model).alphas_cumprod
    assert found[-1] < 1e-8
    torch.testing.assert_close(found, expected, rtol=1e-3, atol=0)
