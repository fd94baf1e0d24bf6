"""The shared path of score distillation, on a stub that misbehaves on request, and the guidance
with the exact score.
"""

import math

import numpy as np
import pytest
import torch
from omegaconf import OmegaConf

from threestudio_gaussiandreamer import cameras
from threestudio_gaussiandreamer.core import streams
from threestudio_gaussiandreamer.core.errors import UserError
from threestudio_gaussiandreamer.diffusion import sds
from threestudio_gaussiandreamer.guidance.base import NonFiniteScore, ScoreDistillation
from threestudio_gaussiandreamer.guidance.exact_score import ExactScoreGuidance, direction_indices
from threestudio_gaussiandreamer.host import find
from threestudio_gaussiandreamer.meshes.raycast import MeshCaster

trimesh = pytest.importorskip("trimesh")
pytest.importorskip("embreex")


def uniform(*shape, seed=0):
    return torch.rand(shape, generator=torch.Generator().manual_seed(seed))


# The shared path


class Stub(ScoreDistillation):
    """Predicts the noise plus the latent (so that the gradient is w x), or what ``spoil`` makes of
    it.
    """

    spoil = staticmethod(lambda eps, step: eps)
    unconditional = None

    def encode(self, rgb, **batch):
        self.latents = 2 * rgb - 1
        return self.latents

    def decode(self, latents):
        return (latents + 1) / 2

    def condition(self, prompt_utils, **batch):
        return batch.get("azimuth")

    def predict(self, z, t, condition):
        noise = streams.normal_per_item(tuple(z.shape), 0, "noise", self.step)
        abar = self.alphas_cumprod[t]
        x = sds.predict_x0(z, noise, abar)
        return self.spoil(
            noise + x, self.step
        ), None if self.unconditional is None else noise + self.unconditional * x


def step(guidance, rgb, **batch):
    rgb = rgb.clone().requires_grad_()
    out = guidance(rgb, None, **batch)
    out["loss_sds"].backward()
    return out, rgb.grad


def test_the_gradient_is_w_times_the_residual_over_the_batch():
    guidance, rgb = Stub({"guidance_scale": 1.0}), uniform(4, 6, 5, 3)
    out, grad = step(guidance, rgb)
    t = sds.timesteps(4, 20, 980, seed=0, step=0)
    weight = (1 - guidance.alphas_cumprod[t]).float().reshape(4, 1, 1, 1)
    # predict_x0 in float32 loses sigma/a = 13 times the rounding of z at t = 980
    torch.testing.assert_close(grad, 2 * weight * (2 * rgb - 1) / 4, rtol=0, atol=1e-5)
    assert (out["min_step"], out["max_step"], out["bad_items"]) == (20, 980, 0)
    torch.testing.assert_close(out["grad_norm"], (weight * (2 * rgb - 1)).norm(), rtol=1e-4, atol=0)


def test_guidance_scale_extrapolates_in_the_usual_convention():
    guidance, rgb = Stub({"guidance_scale": 5.0}), uniform(2, 4, 4, 3)
    guidance.unconditional = 0.5
    plain = Stub({"guidance_scale": 1.0})
    # 0.5 + 5 (1 - 0.5) = 3 times the conditional residual
    torch.testing.assert_close(step(guidance, rgb)[1], 3 * step(plain, rgb)[1], rtol=0, atol=3e-5)


def test_draws_are_a_function_of_step_and_item(monkeypatch):
    rgb = uniform(4, 4, 4, 3)
    guidance = Stub({})
    guidance.update_step(0, 7)
    first, again = guidance.add_noise(rgb.movedim(-1, 1)), guidance.add_noise(rgb.movedim(-1, 1))
    assert torch.equal(first.z, again.z)
    assert torch.equal(guidance.add_noise(rgb[:2].movedim(-1, 1)).z, first.z[:2])
    guidance.update_step(0, 8)
    other = guidance.add_noise(rgb.movedim(-1, 1))
    assert not torch.equal(other.t, first.t) and not torch.equal(other.noise, first.noise)
    monkeypatch.setenv("PL_GLOBAL_SEED", "5")
    assert not torch.equal(guidance.add_noise(rgb.movedim(-1, 1)).noise, other.noise)


def test_schedules_are_evaluated_at_every_step():
    cfg = OmegaConf.create(
        {"max_step_percent": [500, 0.98, 0.55, 501], "grad_clip": [0, 1.5, 2.0, 1000]}
    )
    guidance = Stub(cfg)
    seen = {}
    for at in (0, 500, 501, 1000, 2000):
        guidance.update_step(0, at)
        seen[at] = (guidance.min_step, guidance.max_step, guidance.grad_clip)
    assert seen == {
        0: (20, 980, 1.5),
        500: (20, 980, 1.75),
        501: (20, 550, 1.7505),
        1000: (20, 550, 2.0),
        2000: (20, 550, 2.0),
    }


def test_clipping_is_elementwise_on_the_latents_gradient():
    rgb = uniform(2, 4, 4, 3)
    _, free = step(Stub({}), rgb)
    _, clipped = step(Stub({"grad_clip": 0.05}), rgb)
    limit = 0.05 * 2 / 2  # dlatent/drgb = 2, batch of 2
    torch.testing.assert_close(clipped, free.clamp(-limit, limit), rtol=0, atol=1e-6)
    assert (free.abs() > limit).any()


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_bad_items_are_masked_and_the_others_keep_their_gradient_bit_for_bit(value, caplog):
    rgb = uniform(4, 4, 4, 3)
    guidance = Stub({"grad_clip": 10.0})
    _, expected = step(guidance, rgb)

    def spoil(eps, step):
        eps = eps.clone()
        eps[1, 0, 2, 3] = value
        return eps

    guidance.spoil = spoil
    out, grad = step(guidance, rgb)
    assert out["bad_items"] == 1 and guidance.bad_items == 1
    assert torch.equal(grad[[0, 2, 3]], expected[[0, 2, 3]])
    assert (
        (grad[1] == 0).all()
        and torch.isfinite(out["loss_sds"])
        and torch.isfinite(out["grad_norm"])
    )


def test_an_encoder_that_overflows_spoils_only_its_item():
    class Overflowing(Stub):
        def encode(self, rgb, **batch):
            scale = torch.tensor([1.0, math.inf, 1.0]).reshape(3, 1, 1, 1)
            return super().encode(rgb) * scale

    rgb = uniform(3, 4, 4, 3)
    _, expected = step(Stub({}), rgb)
    out, grad = step(Overflowing({}), rgb)
    assert out["bad_items"] == 1 and (grad[1] == 0).all()
    assert torch.equal(grad[[0, 2]], expected[[0, 2]])


def test_ten_bad_steps_in_a_row_end_the_run_with_a_named_error():
    guidance, rgb = Stub({}), uniform(2, 4, 4, 3)

    def spoil(eps, step):
        return eps * math.nan if step != 5 else eps

    guidance.spoil = spoil
    for at in range(15):  # five bad, one good, nine bad
        guidance.update_step(0, at)
        step(guidance, rgb)
    guidance.update_step(0, 15)
    with pytest.raises(NonFiniteScore, match="10 steps in a row"):
        step(guidance, rgb)
    assert guidance.bad_items == 30


def test_autocast_changes_nothing():
    rgb = uniform(2, 4, 4, 3)
    _, expected = step(Stub({}), rgb)
    with torch.autocast("cpu", torch.bfloat16):
        _, grad = step(Stub({}), rgb)
    assert grad.dtype == torch.float32 and torch.equal(grad, expected)


def test_latents_can_be_given_directly():
    guidance, latents = Stub({}), uniform(2, 4, 4, 3)
    rgb = latents.clone().requires_grad_()
    guidance(rgb, None, rgb_as_latents=True)["loss_sds"].backward()
    t = sds.timesteps(2, 20, 980, seed=0, step=0)
    weight = (1 - guidance.alphas_cumprod[t]).float().reshape(2, 1, 1, 1)
    torch.testing.assert_close(rgb.grad, weight * latents / 2, rtol=0, atol=1e-5)


def test_evaluation_has_what_the_hosts_saver_reads():
    guidance = Stub({"max_items_eval": 2, "eval_steps": 3})
    batch = {
        "elevation": torch.zeros(3),
        "azimuth": torch.tensor([0.0, 90, 180]),
        "camera_distances": torch.full((3,), 2.5),
    }
    out = guidance(uniform(3, 8, 6, 3), None, guidance_eval=True, **batch)["eval"]
    for name in ("imgs_noisy", "imgs_1step", "imgs_1orig", "imgs_final"):
        assert out[name].shape == (2, 8, 6, 3)
    assert out["bs"] == 2 and len(out["noise_levels"]) == 2
    assert [text.split("\n")[1:] for text in out["texts"]] == [
        ["e0.0", "a0.0", "c2.50"],
        ["e0.0", "a90.0", "c2.50"],
    ]


@pytest.mark.parametrize(
    ("cfg", "message"),
    [
        ({"min_step_percent": 0.6, "max_step_percent": 0.5}, "above max_step_percent"),
        (
            {"min_step_percent": 0.6, "max_step_percent": [500, 0.98, 0.55, 501]},
            "above max_step_percent",
        ),
        ({"max_step_percent": 1.5}, "max_step_percent: expected values of 1 or less"),
        ({"grad_clip": [0, 1, 2, 3, 4]}, "system.guidance.grad_clip"),
        ({"weighting_strategy": "sdss"}, "did you mean 'sds'"),
        ({"max_bad_steps": 0}, "max_bad_steps"),
    ],
)
def test_bad_options_are_named_at_once(cfg, message):
    with pytest.raises(UserError, match=message):
        Stub(cfg)


# The exact score


@pytest.fixture(scope="module")
def mesh_path(tmp_path_factory):
    """A ball, red in front, green behind, blue on top, with a nose."""
    ball = trimesh.creation.icosphere(4, 1.0)
    nose = trimesh.creation.icosphere(2, 0.35)
    nose.apply_translation([1.1, 0, 0])
    mesh = trimesh.util.concatenate([ball, nose])
    colors = np.full((len(mesh.vertices), 3), 60)
    colors[mesh.vertices[:, 0] > 0.1] = [230, 30, 30]
    colors[mesh.vertices[:, 0] < -0.1] = [20, 200, 40]
    colors[mesh.vertices[:, 2] > 0.6] = [40, 60, 240]
    mesh.visual = trimesh.visual.ColorVisuals(mesh, vertex_colors=colors)
    path = tmp_path_factory.mktemp("mesh") / "ball.ply"
    mesh.export(path)
    return str(path)


def guidance(mesh_path, **options):
    return ExactScoreGuidance({"mesh": mesh_path, "bank_views": 24, **options})


def batch(*azimuths, elevation=10.0, height=16, width=16):
    values = (
        torch.full((len(azimuths),), elevation),
        torch.tensor(azimuths),
        torch.full((len(azimuths),), 2.7),
    )
    fovy = torch.full((len(azimuths),), math.radians(50))
    return {
        "c2w": cameras.orbit_c2w(*values),
        "fovy": fovy,
        "elevation": values[0],
        "azimuth": values[1],
        "camera_distances": values[2],
        "height": height,
        "width": width,
    }


VIEWS = (0.0, 100.0, 180.0)
BACKGROUNDS = torch.tensor([[0.0, 0, 0], [1, 1, 1], [0.3, 0.9, 0.1]])[:, None, None]


def test_it_is_registered():
    assert find("exact-score-guidance").__qualname__ == "ExactScoreGuidance"


def test_pictures_cast_beforehand_are_not_cast_again(mesh_path, monkeypatch):
    views, cast, render = batch(*VIEWS), [], MeshCaster.render_views
    monkeypatch.setattr(
        MeshCaster,
        "render_views",
        lambda self, c, *size, **o: cast.append(len(c)) or render(self, c, *size, **o),
    )

    def cast_and_seen(**options):
        ahead, now = guidance(mesh_path, **options), guidance(mesh_path)
        ahead.truth.prefetch(views["c2w"], views["fovy"], 16, 16)
        before = sum(cast)
        seen = ahead.truth.render(views)
        counts = before, sum(cast) - before
        assert torch.equal(seen, now.truth.render(views))
        cast.clear()
        return counts

    assert cast_and_seen() == (3, 0)
    assert cast_and_seen(max_cached_targets=2) == (
        0,
        3,
    )  # the first would be gone when the last is there
    assert cast_and_seen(mode="view-agnostic", bank_includes_view=False) == (
        0,
        3,
    )  # which compares with the bank alone


def test_the_target_is_the_mesh_on_the_renders_background(mesh_path):
    exact = guidance(mesh_path)
    target = exact.truth.render(batch(*VIEWS), BACKGROUNDS)
    assert target.shape == (3, 16, 16, 3)
    np.testing.assert_allclose(target[:, 0, 0], BACKGROUNDS[:, 0, 0], atol=1e-6)
    red, _, green = target[:, 8, 8]
    assert red.argmax() == 0 and green.argmax() == 1
    per_pixel = BACKGROUNDS.expand(3, 16, 16, 3)
    torch.testing.assert_close(exact.truth.render(batch(*VIEWS), per_pixel), target)
    assert exact.truth.render(batch(*VIEWS), size=(8, 12)).shape == (3, 8, 12, 3)
    assert torch.equal(exact.truth.render(batch(*VIEWS))[:, 0, 0], torch.zeros(3, 3))


def test_view_exact_without_width_is_a_weighted_squared_error(mesh_path):
    """The noise cancels: the gradient is w (a / sigma) (x - target) with images in [-1, 1]."""
    exact, rgb = guidance(mesh_path), uniform(3, 16, 16, 3)
    out, grad = step(exact, rgb, **batch(*VIEWS), comp_rgb_bg=BACKGROUNDS)
    abar = exact.alphas_cumprod[sds.timesteps(3, 20, 980, seed=0, step=0)]
    weight = (abar * (1 - abar)).sqrt().float().reshape(3, 1, 1, 1)
    expected = 2 * weight * 2 * (rgb - exact.truth.render(batch(*VIEWS), BACKGROUNDS)) / 3
    torch.testing.assert_close(grad, expected, rtol=0, atol=1e-5)
    assert out["perplexity"] == 1
    _, none = step(
        exact,
        exact.truth.render(batch(*VIEWS), BACKGROUNDS),
        **batch(*VIEWS),
        comp_rgb_bg=BACKGROUNDS,
    )
    assert none.abs().max() < 1e-5  # float32 rounding of z against noise of size 1


def test_a_batch_is_its_items(mesh_path):
    """With noise drawn per item the first item's gradient doesn't know of the others."""
    rgb = uniform(3, 16, 16, 3)
    options = {"mode": "view-agnostic", "space": "latent", "latent_size": 4, "guidance_scale": 3.0}
    views = batch(*VIEWS)
    _, together = step(guidance(mesh_path, **options), rgb, **views, comp_rgb_bg=BACKGROUNDS)
    first = {key: value[:1] if torch.is_tensor(value) else value for key, value in views.items()}
    _, alone = step(guidance(mesh_path, **options), rgb[:1], **first, comp_rgb_bg=BACKGROUNDS[:1])
    torch.testing.assert_close(3 * together[:1], alone, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("mode", ["view-exact", "direction-bins", "view-agnostic"])
@pytest.mark.parametrize("space", ["pixel", "latent"])
@pytest.mark.parametrize("scale", [1.0, 7.5])
def test_every_mode_runs_on_constant_and_on_pixel_backgrounds_alike(mesh_path, mode, space, scale):
    exact = guidance(
        mesh_path, mode=mode, space=space, guidance_scale=scale, latent_size=4, std=0.1
    )
    rgb = uniform(3, 16, 16, 3)
    _, constant = step(exact, rgb, **batch(*VIEWS), comp_rgb_bg=BACKGROUNDS)
    _, pixels = step(exact, rgb, **batch(*VIEWS), comp_rgb_bg=BACKGROUNDS.expand(3, 16, 16, 3))
    assert torch.isfinite(constant).all() and constant.abs().max() > 0
    # the pooled bank is float32, the bank of pixel backgrounds bytes: 0.5/255, magnified by the
    # scale and the latent's
    torch.testing.assert_close(
        pixels, constant, rtol=0, atol=0.02 * scale * constant.abs().max().item()
    )


def descend(exact, rgb, views, steps=60):
    """Gradient descent of free pictures; the learning rate undoes the mean weight."""
    rgb = rgb.clone()
    for at in range(steps):
        exact.update_step(0, at)
        out, grad = step(exact, rgb, **views)
        rgb -= 0.4 * grad
    return rgb, out


def test_view_exact_descends_to_the_truth_and_agnostic_to_some_view(mesh_path):
    views = batch(180.0)
    start = 0.5 * torch.ones(1, 16, 16, 3)
    exact = guidance(mesh_path)
    found, _ = descend(exact, start, views)
    torch.testing.assert_close(found, exact.truth.render(views), rtol=0, atol=1e-3)
    blind = guidance(
        mesh_path, mode="view-agnostic", max_step_percent=0.4
    )  # where the posterior is one view
    bank = blind.bank(16, 16).rgba[..., :3] / 255  # on black
    found, out = descend(blind, bank[3:4], batch(float(blind.bank_orbit.azimuth[3] + 180)))
    torch.testing.assert_close(
        found, bank[3:4], rtol=0, atol=0.01
    )  # it stays the view that it is, whatever the camera
    assert out["perplexity"] >= 1


def test_direction_bins_pull_towards_views_of_the_cameras_side(mesh_path):
    """From grey, the picture of a camera behind the ball turns green, in front red."""
    binned = guidance(mesh_path, mode="direction-bins", bank_elevation_range=[0.0, 20.0])
    views = batch(0.0, 180.0)
    found, _ = descend(binned, 0.5 * torch.ones(2, 16, 16, 3), views, steps=80)
    front, back = found[:, 6:10, 6:10].mean(dim=(1, 2))
    assert front.argmax() == 0 and back.argmax() == 1


def test_guidance_between_mixtures_extrapolates_from_the_bank_mean(mesh_path):
    """At high noise a scale above 1 moves away from what the bank has in common."""
    views, rgb = batch(0.0), uniform(1, 16, 16, 3)
    options = {"space": "latent", "latent_size": 4, "min_step_percent": 0.98}
    plain, strong = (
        step(guidance(mesh_path, guidance_scale=scale, **options), rgb, **views)[1]
        for scale in (1.0, 30.0)
    )
    assert strong.norm() > 3 * plain.norm()


def test_the_latent_has_unit_variance_on_the_bank(mesh_path):
    exact = guidance(mesh_path, space="latent", latent_size=4, latent_channels=4)
    bank = exact.bank(16, 16)
    latents = bank.latent.encode_pooled(bank.pooled[:, :3])
    assert latents.shape == (24, 4, 4, 4) and math.isclose(latents.std(), 1, rel_tol=1e-4)


@pytest.mark.parametrize("size", [(16, 16), (32, 32), (24, 24), (32, 48)])
def test_renders_are_resized_to_the_guidance_size(mesh_path, size):
    exact = guidance(mesh_path, image_size=16, mode="view-agnostic", space="latent", latent_size=8)
    height, width = size
    _, grad = step(
        exact, uniform(2, height, width, 3), **batch(0.0, 50.0, height=height, width=width)
    )
    assert grad.shape == (2, height, width, 3) and torch.isfinite(grad).all()


def test_directions_follow_threestudios_rules():
    elevation = torch.tensor([0.0, 0, 0, 0, 0, 61, 0, 0])
    azimuth = torch.tensor([0.0, 44, 46, 134, 136, 0, -170, 350])
    names = [
        ("side", "front", "back", "overhead")[i] for i in direction_indices(elevation, azimuth)
    ]
    assert names == ["front", "front", "side", "side", "back", "overhead", "back", "front"]


def test_a_direction_without_bank_views_takes_all(mesh_path):
    exact = guidance(mesh_path, mode="direction-bins", bank_elevation_range=[0.0, 20.0])
    views = {
        "elevation": torch.tensor([70.0, 10.0, 10.0]),
        "azimuth": torch.tensor([0.0, 0.0, 180.0]),
    }
    overhead, front, back = exact._members(views, 3)
    assert overhead.all() and 0 < front.sum() < 24 and not (front & back).any()


@pytest.mark.parametrize(("mode", "modes"), [("view-exact", 1), ("view-agnostic", 25)])
def test_the_cameras_own_view_is_one_of_the_modes_unless_it_is_left_out(mesh_path, mode, modes):
    for include in (True, False):
        exact = guidance(mesh_path, mode=mode, bank_includes_view=include)
        exact.encode(uniform(1, 3, 16, 16))
        (mixture,) = exact.condition(**batch(30.0))
        own = (mixture.modes[0] + 1) / 2
        is_own = torch.allclose(own.movedim(0, -1), exact.truth.render(batch(30.0))[0], atol=1e-6)
        left_out = mode == "view-agnostic" and not include
        assert len(mixture.modes) == modes - left_out and is_own != left_out


def test_evaluation_shows_the_truth(mesh_path):
    exact = guidance(mesh_path)
    views = batch(*VIEWS)
    out = exact(uniform(3, 16, 16, 3), None, guidance_eval=True, **views, comp_rgb_bg=BACKGROUNDS)[
        "eval"
    ]
    target = exact.truth.render(views, BACKGROUNDS)
    for name in ("imgs_1step", "imgs_1orig", "imgs_final"):
        torch.testing.assert_close(
            out[name], target, rtol=0, atol=1e-4
        )  # float32 noise times sigma/a


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"mesh": ""}, "guidance.mesh"),
        ({"mesh": "nowhere.glb"}, "does not exist"),
        ({"mode": "view-exat"}, "did you mean 'view-exact'"),
        ({"space": "latents"}, "did you mean 'latent'"),
        ({"latent_channels": 2}, "latent_channels"),
        ({"std": -1.0}, "std"),
        ({"temperature": 0.0}, "temperature"),
        ({"bank_views": 0}, "bank_views"),
        ({"bank_distance_range": [3.0, 2.0]}, "bank_distance_range"),
    ],
)
def test_bad_options_of_the_exact_score_are_named(mesh_path, options, message):
    with pytest.raises(UserError, match=message):
        guidance(**{"mesh_path": mesh_path, **options})


def test_sizes_that_do_not_fit_are_named(mesh_path):
    with pytest.raises(UserError, match="latent_size"):
        step(
            guidance(mesh_path, space="latent", latent_size=5), uniform(1, 16, 16, 3), **batch(0.0)
        )
    with pytest.raises(UserError, match="GiB"):
        step(
            guidance(mesh_path, mode="view-agnostic", bank_views=2000),
            uniform(1, 512, 512, 3),
            **batch(0.0),
        )
    with pytest.raises(UserError, match="rgb_as_latents"):
        guidance(mesh_path)(uniform(1, 16, 16, 3), None, rgb_as_latents=True, **batch(0.0))
