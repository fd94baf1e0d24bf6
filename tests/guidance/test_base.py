"""The gradient of Stable Diffusion's guidance: against float64, in closed form, and in half
precision.
"""

import math
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
import torch.nn.functional as F
from torch import nn

from tests.helpers.tiny_guidance import (
    BATCH,
    PREDICTIONS,
    Recorder,
    gradient,
    guidance,
    relative,
    renders,
)
from threestudio_gaussiandreamer.core import streams
from threestudio_gaussiandreamer.guidance import base, half_precision, text_to_image
from threestudio_gaussiandreamer.guidance.base import NonFiniteScore
from threestudio_gaussiandreamer.guidance.half_precision import (
    PerItemLossScale,
    weights_type,
)
from threestudio_gaussiandreamer.guidance.stable_diffusion import StableDiffusionGuidance

pytest.importorskip("diffusers")

CPUINFO = Path("/proc/cpuinfo")


# Against float64 by hand
# --------------------------------------------------------------------------------------------------


def reference_gradient(model, prediction, prompt_utils, rgb, *, scale, clip=None, step=0):
    """Compute the SDS gradient at the render in float64: item by item, one forward pass per prompt,
    with the formulas of the papers.
    """
    from diffusers import AutoencoderKL, UNet2DConditionModel

    unet = UNet2DConditionModel.from_pretrained(model, subfolder="unet").double().eval()
    vae = AutoencoderKL.from_pretrained(model, subfolder="vae").double().eval()
    betas = torch.linspace(math.sqrt(0.00085), math.sqrt(0.012), 1000, dtype=torch.float64) ** 2
    alphas = torch.cumprod(1 - betas, 0)
    cond, uncond = prompt_utils.get_text_embeddings(**BATCH).double().chunk(2)
    total = torch.zeros_like(rgb, dtype=torch.float64)
    for i, image in enumerate(rgb.detach().double()):
        draw = lambda stream, i=i: streams.generator(0, stream, step, i)  # noqa: E731
        t = int(torch.randint(20, 981, (), generator=draw("timestep")))
        abar = alphas[t]
        image = image.permute(2, 0, 1)[None].requires_grad_()
        posterior = vae.encode(
            F.interpolate(image, (64, 64), mode="bilinear", align_corners=False) * 2 - 1
        ).latent_dist
        x = 0.18215 * (
            posterior.mean + posterior.std * torch.randn(4, 8, 8, generator=draw("vae")).double()
        )
        eps = torch.randn(4, 8, 8, generator=draw("noise")).double()
        z = abar.sqrt() * x + (1 - abar).sqrt() * eps
        with torch.no_grad():
            predicted = [
                unet(z, t, encoder_hidden_states=text[i : i + 1]).sample for text in (cond, uncond)
            ]
        if prediction == "v_prediction":
            predicted = [abar.sqrt() * v + (1 - abar).sqrt() * z for v in predicted]
        grad = (1 - abar) * (predicted[1] + scale * (predicted[0] - predicted[1]) - eps)
        grad = grad if clip is None else grad.clamp(-clip, clip)
        (back,) = torch.autograd.grad(x, image, grad.detach() / len(rgb))
        total[i] = back[0].permute(1, 2, 0)
    return total


@pytest.mark.parametrize("size", [64, 128])
@pytest.mark.parametrize("prediction", PREDICTIONS)
def test_the_gradient_is_that_of_a_float64_reference(models, prompts, prediction, size):
    guide = guidance(models, prediction)
    rgb = renders(size=size)
    mine, _ = gradient(guide, prompts[False], rgb)
    # guidance 100 magnifies the rounding of float32 (6e-8) a hundredfold; measured 1e-6 to 3e-6
    assert (
        relative(
            mine,
            reference_gradient(models[prediction], prediction, prompts[False], rgb, scale=100.0),
        )
        < 1e-5
    )


def test_clip_scale_and_step_reach_the_gradient(models, prompts):
    guide = guidance(models, guidance_scale=7.5, grad_clip=0.5)
    guide.update_step(0, 3)
    rgb = renders()
    expected = reference_gradient(
        models["epsilon"], "epsilon", prompts[False], rgb, scale=7.5, clip=0.5, step=3
    )
    assert relative(gradient(guide, prompts[False], rgb)[0], expected) < 1e-5


# In closed form
# --------------------------------------------------------------------------------------------------


class ExactUNet(nn.Module):
    """The exact score of known latents with the interface of a UNet: of the first latent for
    prompts of ones, of all for prompts of zeros.
    """

    def __init__(self, bank, std, alphas, prediction):
        super().__init__()
        self.bank, self.std, self.alphas, self.prediction = bank, std, alphas, prediction
        self.config = SimpleNamespace(
            encoder_hid_dim=None, cross_attention_dim=5, sample_size=bank.shape[-1]
        )

    def forward(self, sample, timestep, encoder_hidden_states):
        from threestudio_gaussiandreamer.diffusion.exact_score import denoise

        abar = self.alphas[timestep]
        modes = self.bank.flatten(1).to(sample)
        everything = torch.zeros(len(sample), len(modes), dtype=torch.float64)
        alone = everything.masked_fill(torch.arange(len(modes)) > 0, -math.inf)
        prior = torch.where(
            encoder_hidden_states.mean(dim=(1, 2))[:, None] > 0.5, alone, everything
        )
        eps = denoise(sample.flatten(1), abar, modes, std=self.std, log_prior=prior).eps.view_as(
            sample
        )
        a, sigma = (root.sqrt().to(sample)[:, None, None, None] for root in (abar, 1 - abar))
        x0 = (sample - sigma * eps) / a
        return SimpleNamespace(
            sample={"epsilon": eps, "v_prediction": a * eps - sigma * x0, "sample": x0}[
                self.prediction
            ]
        )


class LinearVAE(nn.Module):
    """Average pooling and a colour matrix with the interface of a VAE."""

    def __init__(self, matrix, factor):
        super().__init__()
        self.matrix, self.factor, self.config = matrix, factor, SimpleNamespace(scaling_factor=0.5)

    def encode(self, images):
        mean = torch.einsum(
            "dc,bchw->bdhw", self.matrix.to(images), F.avg_pool2d(images, self.factor)
        )
        return SimpleNamespace(latent_dist=SimpleNamespace(mean=mean, std=torch.zeros_like(mean)))


def marked_prompts():
    def get_text_embeddings(elevation, azimuth, camera_distances, view_dependent_prompting=True):
        return torch.cat([torch.ones(len(elevation), 2, 5), torch.zeros(len(elevation), 2, 5)])

    return SimpleNamespace(use_perp_neg=False, get_text_embeddings=get_text_embeddings)


def exact_guidance(models, prediction, bank, std, **options):
    guide = guidance(models, **options)
    guide.prediction_type = prediction
    guide.unet, guide.text_width = ExactUNet(bank, std, guide.alphas_cumprod, prediction), 5
    guide.vae = LinearVAE(torch.randn(4, 3, generator=torch.Generator().manual_seed(3)), 8)
    return guide


def adjoint(guide, latent_gradient, size):
    """Return the linear encoder's gradient with respect to the render: the transposed matrix,
    spread over each pooled square.
    """
    matrix = guide.vae.matrix.double()
    pixels = (
        torch.einsum("dc,bdhw->bchw", matrix, latent_gradient)
        * guide.vae.config.scaling_factor
        * 2
        / guide.vae.factor**2
    )
    return F.interpolate(pixels, size=(size, size), mode="nearest").permute(0, 2, 3, 1)


@pytest.mark.parametrize("weighting", ["sds", "uniform", "fantasia3d"])
@pytest.mark.parametrize("prediction", [*PREDICTIONS, "sample"])
def test_the_gradient_towards_one_known_image_is_the_closed_form(models, prediction, weighting):
    """With one mode of zero width the noise cancels: grad = w(t) a / sigma (x - x1) for
    any noise.
    """
    bank = torch.randn(1, 4, 8, 8, generator=torch.Generator().manual_seed(1))
    guide = exact_guidance(
        models,
        prediction,
        bank,
        0.0,
        guidance_scale=1.0,
        weighting_strategy=weighting,
        min_step_percent=0.2,
    )
    rgb = renders()
    mine, _ = gradient(guide, marked_prompts(), rgb)
    x = guide.encode(rgb.detach().movedim(-1, 1)).double()
    abar = guide.alphas_cumprod[guide.add_noise(x.float()).t]
    weight = {
        "sds": 1 - abar,
        "uniform": torch.ones(4).double(),
        "fantasia3d": abar.sqrt() * (1 - abar),
    }[weighting]
    expected = (weight * (abar / (1 - abar)).sqrt())[:, None, None, None] * (x - bank.double()) / 4
    # float32 in z and the score; the noise, a few times larger than what is left, cancels: measured
    # below 2e-6
    assert relative(mine, adjoint(guide, expected, 64)) < 1e-5
    closer = rgb.detach() - 1e-3 * mine / mine.abs().max()

    def distance(image):
        return (guide.encode(image.movedim(-1, 1)) - bank).square().sum()

    assert distance(closer) < distance(rgb.detach())


@pytest.mark.parametrize("prediction", PREDICTIONS)
@pytest.mark.parametrize("scale", [2.0, 100.0])
def test_guidance_between_two_mixtures_is_the_closed_form(models, prediction, scale):
    """One image against five, of positive width; the posterior is computed here in float64."""
    draw = torch.Generator().manual_seed(2)
    bank, std = 0.3 * torch.randn(5, 4, 8, 8, generator=draw), 0.5
    guide = exact_guidance(
        models, prediction, bank, std, guidance_scale=scale, min_step_percent=0.3
    )
    rgb = renders()
    mine, _ = gradient(guide, marked_prompts(), rgb)
    noised = guide.add_noise(guide.encode(rgb.detach().movedim(-1, 1)))
    abar = guide.alphas_cumprod[noised.t][:, None]
    variance = abar * std**2 + 1 - abar
    z, modes = noised.z.double().flatten(1), bank.double().flatten(1)
    distances = (z[:, None] - abar[..., None].sqrt() * modes).square().sum(-1)
    shares = torch.softmax(-distances / (2 * variance), dim=1)
    assert ((shares > 0.01).sum(1) > 1).any(), "a posterior of one picture would test nothing"
    toward = lambda mean: (1 - abar).sqrt() * (z - abar.sqrt() * mean) / variance  # noqa: E731
    cond, uncond = toward(modes[0]), toward(shares @ modes)
    eps = (uncond + scale * (cond - uncond)).view_as(noised.z)
    expected = (1 - abar)[..., None, None] * (eps - noised.noise.double()) / 4
    assert relative(mine, adjoint(guide, expected, 64)) < 1e-5


# Half precision
# --------------------------------------------------------------------------------------------------


@pytest.fixture
def half(monkeypatch):
    """Use float16 on the CPU too, where a run would use float32."""
    monkeypatch.setattr(text_to_image, "weights_type", lambda *options: torch.float16)


@pytest.mark.parametrize("native", [False, True])
def test_half_precision_on_a_cpu_is_bfloat16_where_it_is_native(monkeypatch, native):
    monkeypatch.setattr(half_precision, "cpu_multiplies_bfloat16", lambda: native)
    cpu, gpu = torch.device("cpu"), torch.device("cuda")
    cfg = StableDiffusionGuidance.Config()
    assert (weights_type(cfg, gpu), weights_type(cfg, cpu)) == (torch.float16, torch.float32)
    cfg.half_precision_on_cpu = True
    assert weights_type(cfg, cpu) == (torch.bfloat16 if native else torch.float32)
    cfg.half_precision_weights = False
    assert weights_type(cfg, gpu) == weights_type(cfg, cpu) == torch.float32


@pytest.mark.skipif(
    not (hasattr(torch.cpu, "get_capabilities") and CPUINFO.exists()), reason="nothing to compare"
)
def test_which_cpus_multiply_bfloat16():
    flags = set(CPUINFO.read_text().split())
    assert half_precision.cpu_multiplies_bfloat16() == bool(flags & {"avx512_bf16", "amx_bf16"})


def test_the_gradient_in_bfloat16_on_a_cpu(models, prompts, monkeypatch):
    monkeypatch.setattr(half_precision, "cpu_multiplies_bfloat16", lambda: True)
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


@pytest.mark.parametrize("loss_scale", [2.0**-30, 2.0**40])
def test_the_scale_of_the_loss_does_not_matter_in_half_precision(models, prompts, half, loss_scale):
    guide, rgb = guidance(models), renders()
    plain, _ = gradient(guide, prompts[False], rgb)
    (scaled,) = torch.autograd.grad(
        guide(rgb, prompts[False], **BATCH)["loss_sds"] * loss_scale, rgb
    )
    assert torch.equal(scaled / loss_scale, plain)
    assert (plain != 0).float().mean() > 0.99


def test_the_loss_scale_of_each_item_is_undone():
    x = torch.randn(3, 5, generator=torch.Generator().manual_seed(0)).requires_grad_()
    seen, results = [], []
    loss_scale = PerItemLossScale(results.append)
    inner = loss_scale.enter(x) * 1.0
    inner.register_hook(seen.append)
    weights = torch.tensor([[1e-12], [0.0], [3e12]])
    (loss_scale.leave(inner * 1.0) * weights).sum().backward()
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
