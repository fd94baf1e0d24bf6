"""The gradient of Stable Diffusion's guidance: against float64, and in half precision."""

import math

import pytest
import torch
import torch.nn.functional as F

from tests.helpers import tiny_guidance as tiny
from tests.helpers.tiny_guidance import (
    BATCH,
    Recorder,
    gradient,
    guidance,
    relative,
    renders,
)
from threestudio_gaussiandreamer.guidance import base, text_to_image
from threestudio_gaussiandreamer.guidance.base import NonFiniteScore
from threestudio_gaussiandreamer.guidance.stable_diffusion import (
    StableDiffusionGuidance,
    with_loss_scales,
)
from threestudio_gaussiandreamer.guidance.text_to_image import weights_type

pytest.importorskip("diffusers")


# Against float64 by hand
# --------------------------------------------------------------------------------------------------


def reference_gradient(model, prediction, prompt_utils, rgb, **options):
    from diffusers import AutoencoderKL, UNet2DConditionModel

    unet = tiny.in_double(UNet2DConditionModel, model, "unet")
    vae = tiny.in_double(AutoencoderKL, model, "vae")
    betas = torch.linspace(math.sqrt(0.00085), math.sqrt(0.012), 1000, dtype=torch.float64) ** 2
    path = tiny.diffusion_path(torch.cumprod(1 - betas, 0))
    text = prompt_utils.get_text_embeddings(**BATCH).double()

    def network(z, t, row):
        output, (a, sigma) = unet(z, t, encoder_hidden_states=text[row]).sample, path(t)
        return a * output + sigma * z if prediction == "v_prediction" else output

    def encode(image, generator):
        image = F.interpolate(image, (64, 64), mode="bilinear", align_corners=False)
        return 0.18215 * tiny.posterior_sample(vae, image, generator)

    return tiny.reference_gradient(rgb, network, encode, path, **options)


@pytest.mark.parametrize(
    "prediction, size, scale, clip, step",
    [("epsilon", 64, 7.5, 0.5, 3), ("v_prediction", 128, 100.0, None, 0)],
)
def test_the_gradient_is_that_of_a_float64_reference(
    models, prompts, prediction, size, scale, clip, step
):
    guide, rgb = (
        guidance(models, prediction, guidance_scale=scale, grad_clip=clip),
        renders(size=size),
    )
    guide.update_step(0, step)
    mine, _ = gradient(guide, prompts[False], rgb)
    options = {"scale": scale, "clip": clip, "step": step}
    expected = reference_gradient(models[prediction], prediction, prompts[False], rgb, **options)
    # guidance 100 magnifies the rounding of float32 (6e-8) a hundredfold; measured 1e-6 to 3e-6
    assert relative(mine, expected) < 1e-5


# Half precision
# --------------------------------------------------------------------------------------------------


@pytest.fixture
def half(monkeypatch):
    """Use float16 on the CPU too, where a run would use float32."""
    monkeypatch.setattr(text_to_image, "weights_type", lambda *options: torch.float16)


@pytest.mark.parametrize("native", [False, True])
def test_half_precision_on_a_cpu_is_bfloat16_where_it_is_native(monkeypatch, native):
    monkeypatch.setattr(text_to_image, "cpu_multiplies_bfloat16", lambda: native)
    cpu, gpu = torch.device("cpu"), torch.device("cuda")
    cfg = StableDiffusionGuidance.Config()
    assert (weights_type(cfg, gpu), weights_type(cfg, cpu)) == (torch.float16, torch.float32)
    cfg.half_precision_on_cpu = True
    assert weights_type(cfg, cpu) == (torch.bfloat16 if native else torch.float32)
    cfg.half_precision_weights = False
    assert weights_type(cfg, gpu) == weights_type(cfg, cpu) == torch.float32


def test_the_gradient_in_bfloat16_on_a_cpu(models, prompts, monkeypatch):
    monkeypatch.setattr(text_to_image, "cpu_multiplies_bfloat16", lambda: True)
    options = {"half_precision_on_cpu": True, "enable_channels_last_format": True}
    guide, rgb = guidance(models, guidance_scale=4.0, **options), renders()
    assert guide.unet.dtype == guide.vae.dtype == torch.bfloat16
    assert guide.vae.encoder.conv_in.weight.is_contiguous()
    mine, _ = gradient(guide, prompts[False], rgb)
    expected = reference_gradient(models["epsilon"], "epsilon", prompts[False], rgb, scale=4.0)
    assert mine.dtype == torch.float32
    assert 0 < relative(mine, expected) < 0.1  # bfloat16 rounds to 4e-3


def test_half_precision_stays_inside_the_networks(models, prompts, half):
    guide, rgb = guidance(models), renders()
    guide.unet = recorder = Recorder(guide.unet)
    assert {
        parameter.dtype for network in (guide.unet, guide.vae) for parameter in network.parameters()
    } == {torch.float16}
    latents = guide.encode(rgb.movedim(-1, 1))
    mine, out = gradient(guide, prompts[False], rgb)
    assert recorder.calls[0][0][0].dtype == torch.float16
    assert latents.dtype == mine.dtype == out["loss_sds"].dtype == torch.float32
    assert guide.decode(latents).dtype == torch.float32
    with torch.autocast("cpu", torch.bfloat16):
        loss = guide(rgb, prompts[False], **BATCH)["loss_sds"]
    assert torch.equal(mine, torch.autograd.grad(loss, rgb)[0])
    expected = reference_gradient(models["epsilon"], "epsilon", prompts[False], rgb, scale=100.0)
    # float16 rounds to 5e-4, which guidance 100 magnifies: it is the right gradient, not an exact
    # one
    assert relative(mine, expected) < 0.1


def test_the_scale_of_the_loss_does_not_matter_in_half_precision(models, prompts, half):
    guide, rgb = guidance(models), renders()
    plain, _ = gradient(guide, prompts[False], rgb)
    for loss_scale in (2.0**-30, 2.0**40):
        loss = guide(rgb, prompts[False], **BATCH)["loss_sds"] * loss_scale
        assert torch.equal(torch.autograd.grad(loss, rgb)[0] / loss_scale, plain)
    assert (plain != 0).float().mean() > 0.99


def test_the_loss_scale_of_each_item_is_undone():
    x = torch.randn(3, 5, generator=torch.Generator().manual_seed(0)).requires_grad_()
    seen, results = [], []

    def network(x):
        inner = x * 1.0
        inner.register_hook(seen.append)
        return inner * 1.0

    weights = torch.tensor([[1e-12], [0.0], [3e12]])
    (with_loss_scales(network, x, results.append) * weights).sum().backward()
    torch.testing.assert_close(x.grad, weights.expand(3, 5), rtol=0, atol=0)
    peaks = seen[0].abs().amax(1)
    assert (peaks[[0, 2]] >= 64).all() and (peaks[[0, 2]] < 128).all() and peaks[1] == 0
    assert [result.tolist() for result in results] == [[False] * 3]


def test_a_gradient_that_overflows_in_the_encoder_is_left_out_and_counted(
    models, prompts, half, monkeypatch
):
    monkeypatch.setattr(base, "MAX_BAD_STEPS", 3)
    guide, rgb = guidance(models), renders()
    clean, _ = gradient(guide, prompts[False], rgb)
    encode = guide.vae.encode

    def overflowing(images):
        images.register_hook(lambda grad: torch.cat([grad[:1], grad[1:2] * math.inf, grad[2:]]))
        return encode(images)

    guide.vae.encode = overflowing
    corrupted, _ = gradient(guide, prompts[False], rgb)
    assert not corrupted[1].any() and guide.bad_items == 1
    assert torch.equal(corrupted[[0, 2, 3]], clean[[0, 2, 3]])
    with pytest.raises(NonFiniteScore, match="VAE.*half_precision_weights=false"):
        for _ in range(2):
            gradient(guide, prompts[False], rgb)
