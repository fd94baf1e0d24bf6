"""Point-E with tiny weights under the published names (its blocks: ``test_shap_e.py``), and the
sampler along Karras' schedules.
"""

import math

import numpy as np
import pytest
import safetensors.torch
import torch

from tests.helpers import tiny_3d_models as tiny
from tests.helpers.prior_contract import PriorContract, assert_valid
from tests.priors.cases import seeded
from threestudio_gaussiandreamer.core.errors import UserError
from threestudio_gaussiandreamer.priors import karras
from threestudio_gaussiandreamer.priors import point_e as module
from threestudio_gaussiandreamer.priors.point_e import (
    BaseModel,
    PointEPrior,
    Upsampler,
    load_network,
)

FAST = {"num_steps": 3, "num_points": 64}


@pytest.fixture(autouse=True)
def few_points(monkeypatch):
    monkeypatch.setattr(module, "UPSAMPLED", 96)


def make(files, **options):
    return PointEPrior(FAST | files | options)


class TestContract(PriorContract):
    @pytest.fixture
    def make_prior(self, point_e):
        return lambda **options: make(point_e, **options)


# The networks -------------------------------------------------------------------------------------


def both(*names):
    return {f"{name}.{kind}" for name in names for kind in ("weight", "bias")}


LINEAR = ("attn.c_qkv", "attn.c_proj", "ln_1", "mlp.c_fc", "mlp.c_proj", "ln_2")
SHARED = both(
    "time_embed.c_fc", "time_embed.c_proj", "ln_pre", "ln_post", "input_proj", "output_proj",
    *(f"backbone.resblocks.{block}.{name}" for block in range(12) for name in LINEAR),
)  # fmt: skip


def test_names_and_shapes_are_the_published_ones():
    """Those of the configurations ``base40M-textvec`` and ``upsample`` that openai/point-e
    publishes.
    """
    with torch.device("meta"):
        base, upsampler = BaseModel().state_dict(), Upsampler().state_dict()
    buffers = {"channel_scales", "channel_biases"}
    assert set(base) == SHARED | both("clip_embed")
    names = both("cond_point_proj", "clip_embed.0", "clip_embed.1")
    assert set(upsampler) == SHARED | names | buffers
    for model in (base, upsampler):
        assert model["output_proj.weight"].shape == (12, 512)
        assert model["backbone.resblocks.11.attn.c_qkv.weight"].shape == (1536, 512)
    assert base["clip_embed.weight"].shape == (512, 768)
    assert upsampler["clip_embed.1.weight"].shape == (512, 1024)
    assert 40e6 < sum(value.numel() for value in base.values()) < 41e6  # "40M"
    assert module.SCALES[:, 0].tolist() == pytest.approx([2.0] * 3 + [0.007843137255] * 3)
    assert module.BIASES[:, 0].tolist() == [0.0] * 3 + [-1.0] * 3


@torch.no_grad()
def test_points_have_no_order_and_conditions_matter():
    torch.manual_seed(0)
    base, upsampler = BaseModel(64, 1, tiny.FEATURES), Upsampler(64, 1, 40)
    points, timesteps, order = torch.randn(2, 6, 9), torch.tensor([5, 900]), torch.randperm(9)
    condition, coarse = torch.randn(2, tiny.FEATURES), torch.rand(2, 6, 7) * 100
    close = {"atol": 1e-5, "rtol": 1e-5}
    for model, given in ((base, condition), (upsampler, coarse)):
        output = model(points, timesteps, given)
        assert output.shape == (2, 12, 9)
        other = model(points[:, :, order], timesteps, given)
        torch.testing.assert_close(other, output[:, :, order], **close)
        assert (model(points, timesteps, 0 * given) - output).abs().max() > 1e-3
        assert (model(points, timesteps + 50, given) - output).abs().max() > 1e-3
    # of the upsampler's empty image 256 equal tokens; attention would depend on their number
    seen = []
    upsampler.ln_pre.register_forward_hook(lambda module, inputs, output: seen.append(inputs[0]))
    upsampler(torch.randn(1, 6, 9), torch.tensor([5]), torch.rand(1, 6, 7))
    assert seen[0].shape == (1, 1 + 256 + 7 + 9, 64)
    expected = upsampler.clip_embed(torch.zeros(40))
    torch.testing.assert_close(seen[0][0, 1:257], expected.expand(256, 64))


# The prior ----------------------------------------------------------------------------------------


def test_what_points_depend_on(point_e, monkeypatch):
    cloud = make(point_e)("a fox")
    assert_valid(cloud)
    assert len(cloud.points) == 64 + 96 and cloud.faces is None
    # x0 is clamped, and guidance is 3, so coarse points lie within 1 + 2 * 2 = 5 times, further
    # ones within the box
    assert np.abs(cloud.points[64:]).max() <= 0.5 * 1.6 + 1e-5
    np.testing.assert_allclose(cloud.colors * 255, (cloud.colors * 255).round(), atol=1e-4)
    coarse = make(point_e, upsampler=None)
    np.testing.assert_array_equal(cloud.points[:64], coarse("a fox").points)
    same = make(point_e, upsampler=None, prompt="a fox")("a bear").points
    np.testing.assert_array_equal(same, cloud.points[:64])
    others = [coarse("a bear"), make(point_e, upsampler=None, guidance_scale=1.0)("a fox")]
    monkeypatch.setenv("PL_GLOBAL_SEED", "7")
    others.append(coarse("a fox"))
    assert not any(np.allclose(other.points, cloud.points[:64]) for other in others)


def test_units_and_axes(point_e, monkeypatch):
    """With networks that always give one point: x, y, z and a colour, in the networks' units."""

    def fixed(self, points, timesteps, given):
        point = torch.tensor([0.2, 0.4, 0.6, 1.0, 0.2, -1.0])
        return torch.cat([point[None, :, None].expand_as(points)] * 2, dim=1)

    def denoiser(network, levels, **_):
        return lambda x, sigma: network(x, torch.zeros(1))

    monkeypatch.setattr(BaseModel, "forward", fixed)
    monkeypatch.setattr(module.karras, "guided_denoiser", denoiser)
    cloud = make(point_e, upsampler=None)("a fox")
    wanted = 1.6 * np.array([-0.2, 0.1, 0.3])  # (-y, x, z) of half the units
    np.testing.assert_allclose(cloud.points, np.tile(wanted, (64, 1)), atol=1e-5)
    wanted = [1.0, 153 / 255, 0.0]  # 1.2 * 127.5 = 153
    np.testing.assert_allclose(cloud.colors, np.tile(wanted, (64, 1)), atol=1e-6)


def test_sizes_are_read_off_the_weights(tmp_path, point_e):
    torch.save(BaseModel(width=128, layers=3, features=10).state_dict(), tmp_path / "other.pt")
    model = load_network(BaseModel, str(tmp_path / "other.pt"))
    blocks = model.backbone.resblocks
    assert (model.width, len(blocks), blocks[0].attn.heads) == (128, 3, 2)
    assert not model.training and not any(value.requires_grad for value in model.parameters())
    with pytest.raises(UserError, match="clip: .* 24 features, .* 10: use ViT-L/14"):
        make(point_e, checkpoint=str(tmp_path / "other.pt"))("a fox")


def test_other_files_of_the_same_weights(tmp_path, point_e):
    """Cap3D's wrapped checkpoint, torch's old format, and safetensors."""
    state = torch.load(point_e["checkpoint"])
    torch.save({"model_state_dict": state, "epoch": 3}, tmp_path / "finetuned.pth")
    torch.save(state, tmp_path / "old.pt", _use_new_zipfile_serialization=False)
    safetensors.torch.save_file(state, tmp_path / "points.safetensors")
    for name in ("finetuned.pth", "old.pt", "points.safetensors"):
        found = load_network(BaseModel, str(tmp_path / name)).state_dict()
        assert all(torch.equal(found[key], value) for key, value in state.items())
    path = tmp_path / "points.safetensors"
    path.write_bytes(path.read_bytes()[:1000])
    with pytest.raises(UserError, match=r"points\.safetensors': it is truncated"):
        load_network(BaseModel, str(path))


@pytest.mark.parametrize(
    "change, message",
    [
        (lambda state: state.pop("ln_post.bias"), 'Missing key.*"ln_post.bias"'),
        (lambda state: state.update({"extra": torch.zeros(1)}), 'Unexpected key.*"extra"'),
        (lambda state: state.update({"output_proj.bias": torch.zeros(6)}), "size mismatch"),
        (lambda state: state.update({"ln_pre.weight": torch.zeros(65)}), "another model"),
        (lambda state: state.update({"step": 3}), "no weights by name"),
    ],
)
def test_another_models_weights_are_refused(tmp_path, point_e, change, message):
    state = torch.load(point_e["checkpoint"])
    change(state)
    torch.save(state, tmp_path / "spoiled.pt")
    with pytest.raises(UserError, match=message):
        load_network(BaseModel, str(tmp_path / "spoiled.pt"))
    with pytest.raises(UserError, match=r"upsampler checkpoint .* give upsample_40m.pt"):
        load_network(Upsampler, point_e["checkpoint"])


def test_wrong_options_and_missing_files_fail_before_any_work(point_e, tmp_path, monkeypatch):
    for option in ({"checkpoint": ""}, {"num_points": 0}, {"guidance_scale": 0.0}, {"front": "z"}):
        with pytest.raises(UserError, match=next(iter(option)).split("_")[0]):
            make(point_e, **option)
    monkeypatch.setattr(PointEPrior, "condition", lambda *args: pytest.fail("worked"))
    for option in ("checkpoint", "upsampler"):
        with pytest.raises(UserError, match="nothing.pt"):
            make(point_e, **{option: "nothing.pt"})("a fox")
    (tmp_path / "config.json").write_text("{}")
    with pytest.raises(UserError, match="are missing"):
        make(point_e, clip=str(tmp_path)).preflight()


# The sampler --------------------------------------------------------------------------------------

MEAN, SPREAD = 0.3, 0.5


def gaussian_denoiser(x, sigma):
    """Return E[x0 | x0 + sigma eps] of normal data with this mean and standard deviation."""
    return MEAN + SPREAD**2 / (SPREAD**2 + sigma**2) * (x - MEAN)


def test_the_sampler_follows_the_flow_to_second_order():
    """The probability flow keeps the quantile of the widening normal distribution."""
    sigmas = karras.karras_sigmas(64, 160)
    assert len(sigmas) == 65 and sigmas[-1] == 0
    assert (sigmas[0], sigmas[-2]) == pytest.approx((160, 1e-3))
    steps = np.diff(np.array(sigmas[:-1]) ** (1 / 7))
    np.testing.assert_allclose(steps, (1e-3 ** (1 / 7) - 160 ** (1 / 7)) / 63, rtol=1e-9)
    noise = torch.randn(200, generator=seeded(), dtype=torch.float64)
    end = MEAN + SPREAD / math.hypot(SPREAD, 120) * (120 * noise - MEAN)
    errors = []
    for steps in (16, 32, 64, 128):
        sigmas = karras.karras_sigmas(steps, 120)
        sample = karras.sample_heun(gaussian_denoiser, noise, sigmas, generator=seeded())
        errors.append((sample - end).abs().max().item())
    ratios = [coarse / fine for coarse, fine in zip(errors[:-1], errors[1:], strict=True)]
    assert errors[-1] < 2e-3 and all(3.7 < ratio < 4.7 for ratio in ratios)  # order 2


def test_churn_keeps_the_distribution_and_needs_the_generator():
    noise, sigmas = torch.randn(20_000, generator=seeded()), karras.karras_sigmas(64, 120)
    first, again, other = (
        karras.sample_heun(gaussian_denoiser, noise, sigmas, churn=3.0, generator=seeded(seed))
        for seed in (1, 1, 2)
    )
    found = first.mean().item(), first.std().item()
    assert found == pytest.approx((MEAN, SPREAD), abs=0.02)  # 5 sigma of 20,000
    assert torch.equal(first, again) and not torch.allclose(first, other)


def test_a_network_of_timesteps_gives_the_exact_denoiser():
    """A network that predicts the noise of normal data gives the exact denoiser at the noise level
    of each integer timestep.
    """
    alphas_cumprod = karras.cosine_alphas_cumprod()

    def network(z, timesteps):
        level = float(alphas_cumprod[timesteps[0]])
        sigma = math.sqrt((1 - level) / level)
        x = z * math.sqrt(sigma**2 + 1)
        return (x - gaussian_denoiser(x, sigma)) / sigma

    denoise = karras.guided_denoiser(network, alphas_cumprod, prediction="epsilon")
    for timestep in (0, 10, 500, 900):
        sigma = math.sqrt(1 / alphas_cumprod[timestep] - 1) * (1 + 1e-9)  # safe from rounding
        x = torch.linspace(-0.4, 0.4, 9, dtype=torch.float64) * math.hypot(1, sigma)
        wanted = gaussian_denoiser(x, sigma).clamp(-1, 1)
        torch.testing.assert_close(denoise(x, sigma), wanted, atol=1e-6, rtol=0)


def test_schedules_and_timesteps():
    """The end points given by the formulas."""
    cosine, linear = karras.cosine_alphas_cumprod(), karras.linear_alphas_cumprod()
    for levels in (cosine, linear):
        assert len(levels) == 1024 and (np.diff(levels) < 0).all()
    assert cosine[511] == pytest.approx(0.494, abs=0.005)  # cos^2 near 45 degrees
    assert 0 < cosine[-1] < 1e-8  # the cap
    assert linear[0] == pytest.approx(1 - 1e-4 * 1000 / 1024)
    assert linear[-1] == pytest.approx(4.0e-5, rel=0.05)
    between = 0.3 * linear[100] + 0.7 * linear[101]
    assert karras.timestep_of(math.sqrt(1 / between - 1), linear) == 100
    assert karras.timestep_of(1e-6, linear) == 0 and karras.timestep_of(1e6, linear) == 1023


def test_guidance_clamps_before_it_combines_and_none_asks_once():
    def network(z, timesteps):
        assert len(z) == 2 and torch.equal(z[0], z[1])
        return torch.stack([torch.full_like(z[0], 4.0), torch.full_like(z[0], -0.5)])

    levels = np.linspace(0.99, 0.01, 20)
    denoise = karras.guided_denoiser(network, levels, scale=3.0, prediction="sample")
    assert denoise(torch.zeros(1, 5), 1.0).unique().tolist() == [-0.5 + 3 * (1 - -0.5)]
    seen = []
    alone = karras.guided_denoiser(lambda z, t: seen.append(len(z)) or z, levels)
    alone(torch.zeros(1, 5), 1.0)
    assert seen == [1]
