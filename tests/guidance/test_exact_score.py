"""The guidance with the exact score."""

import math

import numpy as np
import pytest
import torch

from tests.diffusion.test_sds import denoised
from tests.guidance.conftest import batch, guidance, step, uniform
from tests.helpers.refusals import refused
from threestudio_gaussiandreamer.diffusion import exact_score as closed_form
from threestudio_gaussiandreamer.diffusion import sds
from threestudio_gaussiandreamer.guidance import exact_score
from threestudio_gaussiandreamer.meshes.raycast import MeshCaster
from threestudio_gaussiandreamer.splatting.cpu import backend as cpu

pytest.importorskip("embreex")

VIEWS = (0.0, 100.0, 180.0)
BACKGROUNDS = torch.tensor([[0.0, 0, 0], [1, 1, 1], [0.3, 0.9, 0.1]])[:, None, None]


def test_planned_pictures_are_cast_with_the_first_one_and_not_again(mesh_path, recorded):
    views, cast = batch(*VIEWS), recorded(MeshCaster, "render_views")
    # if the first would be gone when the last is there, none is cast ahead
    for most, expected in ((512, [3]), (2, [1, 2])):
        truth = guidance(mesh_path, max_cached_targets=most).truth
        truth.prefetch(views["c2w"], views["fovy"], 16, 16)
        assert not cast
        truth.render({**views, "c2w": views["c2w"][:1], "fovy": views["fovy"][:1]})
        seen = truth.render(views)
        assert [len(cameras) for (_, cameras, *_), _ in cast] == expected
        assert torch.equal(seen, guidance(mesh_path).truth.render(views))
        cast.clear()


def test_the_target_is_the_mesh_on_the_renders_background_also_in_evaluation(mesh_path):
    truth, views = guidance(mesh_path).truth, batch(*VIEWS)
    target = truth.render(views, BACKGROUNDS)
    assert target.shape == (3, 16, 16, 3)
    np.testing.assert_allclose(target[:, 0, 0], BACKGROUNDS[:, 0, 0], atol=1e-6)
    red, _, green = target[:, 8, 8]
    assert red.argmax() == 0 and green.argmax() == 1
    torch.testing.assert_close(truth.render(views, BACKGROUNDS.expand(3, 16, 16, 3)), target)
    assert truth.render(views, size=(8, 12)).shape == (3, 8, 12, 3)
    assert torch.equal(truth.render(views)[:, 0, 0], torch.zeros(3, 3))
    exact, views = guidance(mesh_path), batch(*VIEWS) | {"comp_rgb_bg": BACKGROUNDS}
    out = exact(uniform(3, 16, 16, 3), None, guidance_eval=True, **views)["eval"]
    target = exact.truth.render(views, BACKGROUNDS)
    for name in ("imgs_1step", "imgs_1orig", "imgs_final"):  # float32 noise times sigma/a
        torch.testing.assert_close(out[name], target, rtol=0, atol=1e-4)


def test_view_exact_is_a_weighted_squared_error(mesh_path, monkeypatch):
    """The noise cancels: the gradient is w (a / sigma) (x - target) with images in [-1, 1]."""
    exact, rgb, views = guidance(mesh_path), uniform(3, 16, 16, 3), batch(*VIEWS)
    views["comp_rgb_bg"] = BACKGROUNDS
    target = exact.truth.render(views, BACKGROUNDS)
    out, grad = step(exact, rgb, **views)
    abar = exact.alphas_cumprod[sds.timesteps(3, 20, 980, seed=0, step=0)]
    weight = (abar * (1 - abar)).sqrt().float().reshape(3, 1, 1, 1)
    torch.testing.assert_close(grad, 2 * weight * 2 * (rgb - target) / 3, rtol=0, atol=1e-5)
    assert out["perplexity"] == 1
    _, none = step(exact, target, **views)
    assert none.abs().max() < 1e-5  # float32 rounding of z against noise of size 1
    # with the noise, which isn't drawn otherwise
    in_general(monkeypatch)
    monkeypatch.setattr(exact_score.ExactScoreGuidance, "known_residual", lambda *_: None)
    by_noise, expected = step(guidance(mesh_path), rgb, **views)
    torch.testing.assert_close(grad, expected, rtol=1e-4, atol=1e-5 * float(expected.abs().max()))
    assert torch.isclose(out["loss_sds"], by_noise["loss_sds"], rtol=1e-4)
    assert by_noise["perplexity"] == 1


def in_general(monkeypatch):
    monkeypatch.setattr(exact_score.ExactScoreGuidance, "_in_one_pass", lambda *_, **__: None)


@pytest.mark.skipif(cpu.unavailable() is not None, reason=str(cpu.unavailable()))
@pytest.mark.parametrize("width, weighting", [(16, "sds"), (19, "x0")])
def test_one_pass_gives_the_bits_of_the_general_path(mesh_path, monkeypatch, width, weighting):
    options = {"weighting_strategy": weighting}
    rgb, views = uniform(3, 16, width, 3), batch(*VIEWS, width=width)
    views["comp_rgb_bg"] = BACKGROUNDS
    assert guidance(mesh_path, **options)._in_one_pass(rgb, **views) is not None
    out, grad = step(guidance(mesh_path, **options), rgb, **views)
    in_general(monkeypatch)
    expected, expected_grad = step(guidance(mesh_path, **options), rgb, **views)
    assert torch.equal(grad, expected_grad) and grad.abs().max() > 0
    truth = guidance(mesh_path).truth.render(views, BACKGROUNDS)
    assert out.pop("error_to_truth") == pytest.approx((rgb - truth).square().mean().item(), 1e-5)
    assert out.keys() == expected.keys()
    for name, value in expected.items():
        pair = torch.as_tensor(out[name]), torch.as_tensor(value)
        torch.testing.assert_close(*pair, rtol=1e-5, atol=0)


def test_what_one_pass_cannot_compute_takes_the_general_path(mesh_path):
    rgb, views = uniform(3, 16, 16, 3), batch(*VIEWS)
    assert guidance(mesh_path, grad_clip=0.1)._in_one_pass(rgb, **views) is None
    refused("can't take rgb_as_latents", guidance(mesh_path), rgb, **views, rgb_as_latents=True)
    rgb[1, 0, 0, 0] = torch.inf
    out, grad = step(guidance(mesh_path), rgb, **views)
    assert out["bad_items"] == 1 and grad.isfinite().all() and grad[0].abs().max() > 0


@pytest.mark.parametrize(
    "mode, space, scale",
    [
        ("view-exact", "pixel", 1.0),
        ("view-exact", "latent", 7.5),
        ("direction-bins", "pixel", 7.5),
        ("view-agnostic", "latent", 1.0),
    ],
)
def test_every_mode_runs_on_constant_and_on_pixel_backgrounds(mesh_path, mode, space, scale):
    exact = guidance(mesh_path, mode=mode, space=space, guidance_scale=scale, latent_size=4)
    rgb, views = uniform(3, 16, 16, 3), batch(*VIEWS)
    _, constant = step(exact, rgb, **views, comp_rgb_bg=BACKGROUNDS)
    _, pixels = step(exact, rgb, **views, comp_rgb_bg=BACKGROUNDS.expand(3, 16, 16, 3))
    assert torch.isfinite(constant).all() and constant.abs().max() > 0
    # the pooled bank is float32, the bank of pixel backgrounds bytes: 0.5/255, magnified by the
    # scale and the latent's
    atol = 0.02 * scale * constant.abs().max().item()
    torch.testing.assert_close(pixels, constant, rtol=0, atol=atol)
    if mode != "view-agnostic":
        return
    # noise is drawn per item, so the first item's gradient doesn't depend on the others
    first = {key: value[:1] if torch.is_tensor(value) else value for key, value in views.items()}
    _, alone = step(exact, rgb[:1], **first, comp_rgb_bg=BACKGROUNDS[:1])
    torch.testing.assert_close(3 * constant[:1], alone, rtol=1e-5, atol=1e-6)
    latents = exact.bank(16, 16).pictures.layers[:, :4]
    assert latents.shape == (24, 4, 4, 4) and math.isclose(latents.std(), 1, rel_tol=1e-4)


def test_direction_bins_pull_towards_views_of_the_cameras_side(mesh_path, monkeypatch):
    """From grey, the image of a camera behind the ball turns green, in front of it red."""
    monkeypatch.setattr(exact_score, "BANK_ELEVATIONS", (0.0, 20.0))
    binned, rgb = guidance(mesh_path, mode="direction-bins"), 0.5 * torch.ones(2, 16, 16, 3)
    for at in range(80):  # the learning rate cancels the mean weight
        binned.update_step(0, at)
        rgb = rgb - 0.4 * step(binned, rgb, **batch(0.0, 180.0))[1]
    front, back = rgb[:, 6:10, 6:10].mean(dim=(1, 2))
    assert front.argmax() == 0 and back.argmax() == 1


@pytest.mark.parametrize(("mode", "modes"), [("view-exact", 1), ("view-agnostic", 25)])
def test_the_cameras_own_view_is_one_of_the_modes(mesh_path, mode, modes):
    exact = guidance(mesh_path, mode=mode)
    exact.encode(uniform(1, 3, 16, 16))
    (mixture,) = exact.condition(**batch(30.0))
    assert modes == 1 + (0 if mixture.pictures is None else len(mixture.pictures.layers))
    truth = exact.truth.render(batch(30.0))[0]
    torch.testing.assert_close((mixture.own.movedim(0, -1) + 1) / 2, truth)


def test_sizes_that_do_not_fit_are_named(mesh_path):
    odd = {"mesh": "no.glb", "space": "latent", "latent_size": 33, "image_size": 64}
    said = "pictures of 64x64 can't be pooled to a latent 33 high"
    refused(said, exact_score.ExactScoreGuidance, odd)
    latent = guidance(mesh_path, space="latent", latent_size=5)
    large = guidance(mesh_path, mode="view-agnostic", bank_views=2000)
    for exact, size, said in ((latent, 16, "latent_size"), (large, 512, "GiB")):
        refused(said, step, exact, uniform(1, size, size, 3), **batch(0.0))


def test_a_view_without_its_direction_in_the_bank_and_the_count_of_evaluations(mesh_path):
    """The bank has no view from above: such a view's guided score is the conditional one."""
    guide = guidance(mesh_path, mode="direction-bins", guidance_scale=7.5)
    views = batch(0.0, 0.0)
    views["elevation"][1] = 80.0
    z = guide.encode(uniform(2, 3, 16, 16)) + 0.1
    condition = guide.condition(None, **views)
    assert [bool(mixture.log_prior.any()) for mixture in condition] == [True, False]
    cond, uncond = guide.predict(z, torch.tensor([400, 400]), condition)
    assert torch.equal(cond[1], uncond[1]) and not torch.equal(cond[0], uncond[0])
    guide = guidance(mesh_path, mode="direction-bins", guidance_scale=7.5)
    z, t = guide.encode(uniform(2, 3, 16, 16)) + 0.1, torch.tensor([400, 400])
    condition = guide.condition(None, **batch(0.0, 90.0))
    both = guide.predict(z, t, condition)
    assert guide.evaluations == 4
    assert torch.equal(guide.conditional(z, t, condition), both[0])
    assert torch.equal(guide.unconditional(z, t, condition), both[1])
    assert guide.evaluations == 8


MEMBERS = torch.tensor([[1, 1, 0, 1, 0, 1, 1], [0, 0, 0, 0, 0, 0, 1], [1] * 7]).bool()
"""Of each item, in the bank."""
ABAR = sds.sd_alphas_cumprod()[torch.tensor([20, 300, 900])]


@pytest.fixture(params=["pixel", "latent"])
def bank(request):
    rgba = (255 * uniform(7, 8, 8, 4, seed=0)).byte()
    pixels = rgba.movedim(-1, 1) / 255
    if request.param == "pixel":
        return exact_score.Bank.of(rgba, pixels, closed_form.LinearLatent())
    pooled = torch.nn.functional.avg_pool2d(pixels, 2)
    latent = closed_form.LinearLatent(2, closed_form.COLOR_MATRIX)
    return exact_score.Bank.of(rgba, pooled, latent.normalised(pooled[:, :3]))


def predicted(mixtures, z, abar, conditional):
    eps, perplexity, unconditional = exact_score.scores(z.flatten(1), abar, mixtures)
    return (eps, perplexity) if conditional else (unconditional(), None)


@pytest.mark.parametrize("guided", [False, True])
@pytest.mark.parametrize("size, at_a_time", [(1, 100), (1, 3), (8, 1)])
def test_scores_are_those_of_composited_pictures(bank, monkeypatch, size, guided, at_a_time):
    elements = bank.pictures.layers[0].numel()
    monkeypatch.setattr(closed_form, "CPU_CHUNK_ELEMENTS", at_a_time * elements)
    backgrounds = uniform(len(MEMBERS), size, size, 3, seed=1)
    z = bank.latent.encode(exact_score.composite(bank.rgba[: len(MEMBERS)], backgrounds)) + 0.1
    own = z.flip(0)
    items = zip(own, MEMBERS, backgrounds, strict=True)
    mixtures = [exact_score.mixture_of(*item, bank, guided) for item in items]
    of_a_color = size == 1  # whose items have the same pictures
    for conditional in (True, False) if guided else (True,):
        together = predicted(mixtures, z, ABAR, conditional) if of_a_color else None
        for i in range(len(MEMBERS)):
            item = slice(i, i + 1)
            pictures = bank.rgba[MEMBERS[i]] if conditional else bank.rgba
            modes = bank.latent.encode(exact_score.composite(pictures, backgrounds[item]))
            modes = torch.cat([own[item], modes])
            alone = predicted(mixtures[item], z[item], ABAR[item], conditional)
            expected = denoised(z[item].flatten(1).double(), ABAR[item], modes.flatten(1).double())
            for found in (alone, together and [None if x is None else x[item] for x in together]):
                if found is not None:
                    torch.testing.assert_close(found[0].double(), expected[0], rtol=0, atol=1e-4)
                    if conditional:
                        torch.testing.assert_close(found[1], expected[1], rtol=1e-3, atol=0)
