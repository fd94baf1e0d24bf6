"""The computation that all guidances share."""

import math

import pytest
import torch

from tests.guidance.conftest import step, uniform
from threestudio_gaussiandreamer.core import streams
from threestudio_gaussiandreamer.core.errors import UserError
from threestudio_gaussiandreamer.core.host_copies import HostCopy, flush_reads
from threestudio_gaussiandreamer.diffusion import sds
from threestudio_gaussiandreamer.guidance import base
from threestudio_gaussiandreamer.guidance.base import NonFiniteScore, ScoreDistillation

pytest.importorskip("embreex")


class Stub(ScoreDistillation):
    """Predict the noise plus the latent (a gradient w x), or what ``corrupt`` makes of it."""

    corrupt = staticmethod(lambda eps, step: eps)
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
        return self.corrupt(
            noise + x, self.step
        ), None if self.unconditional is None else noise + self.unconditional * x


def test_the_gradient_is_w_times_the_residual_over_the_batch():
    guidance, rgb = Stub({"guidance_scale": 1.0}), uniform(4, 6, 5, 3)
    out, grad = step(guidance, rgb)
    t = sds.timesteps(4, 20, 980, seed=0, step=0)
    weight = (1 - guidance.alphas_cumprod[t]).float().reshape(4, 1, 1, 1)
    # predict_x0 in float32 loses sigma/a = 13 times the rounding of z at t = 980
    torch.testing.assert_close(grad, 2 * weight * (2 * rgb - 1) / 4, rtol=0, atol=1e-5)
    assert (out["min_step"], out["max_step"], out["bad_items"]) == (20, 980, 0)
    torch.testing.assert_close(out["grad_norm"], (weight * (2 * rgb - 1)).norm(), rtol=1e-4, atol=0)


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


@pytest.mark.parametrize("value", [math.nan, -math.inf])
def test_bad_items_of_the_encoder_are_masked_and_the_others_keep_their_gradient(value):
    rgb, guidance = uniform(4, 4, 4, 3), Stub({"grad_clip": 10.0})
    _, expected = step(guidance, rgb)
    with torch.autocast("cpu", torch.bfloat16):  # which changes nothing
        assert torch.equal(step(guidance, rgb)[1], expected)
    factor = torch.ones(4, 1, 1, 1)
    factor[1], encode = value, guidance.encode
    guidance.encode = lambda rgb, **batch: encode(rgb) * factor
    out, grad = step(guidance, rgb)
    assert out["bad_items"] == 1 and guidance.bad_items == 1
    assert torch.equal(grad[[0, 2, 3]], expected[[0, 2, 3]])
    assert (grad[1] == 0).all() and out["loss_sds"].isfinite() and out["grad_norm"].isfinite()


def test_bad_steps_of_a_gpu_are_counted_when_their_numbers_arrive(monkeypatch):
    monkeypatch.setattr(HostCopy, "ready", lambda copy: False)
    guidance, rgb = Stub({}), uniform(2, 4, 4, 3)
    monkeypatch.setattr(base, "MAX_BAD_STEPS", 3)
    guidance.corrupt = lambda eps, step: eps * math.nan
    for at in range(5):
        guidance.update_step(0, at)
        _, grad = step(guidance, rgb)
        assert (grad == 0).all() and guidance.bad_items == 0
    with pytest.raises(NonFiniteScore, match=r"3 steps in a row \(step 2, 6 items so far\)"):
        flush_reads(guidance)


def test_evaluation_has_what_the_hosts_saver_reads():
    angles = {"elevation": torch.zeros(6), "azimuth": torch.tensor([0.0, 90, 180, -90, 0, 0])}
    batch = angles | {"camera_distances": torch.full((6,), 2.5)}
    out = Stub({})(uniform(6, 8, 6, 3), None, guidance_eval=True, **batch)["eval"]
    for name in ("imgs_noisy", "imgs_1step", "imgs_1orig", "imgs_final"):
        assert out[name].shape == (4, 8, 6, 3)
    assert out["bs"] == 4 and len(out["noise_levels"]) == len(out["texts"]) == 4
    assert out["texts"][1].split("\n")[1:] == ["e0.0", "a90.0", "c2.50"]


@pytest.mark.parametrize(
    ("returned", "message"),
    [
        (lambda z: z, r"returned \(4, 3, 6, 5\); expected a pair"),
        (lambda z: (z[:1], None), r"returned \(1, 3, 6, 5\) and NoneType; .* shape \(4, 3, 6, 5\)"),
        (lambda z: (z, z[:, :1]), r"returned \(4, 3, 6, 5\) and \(4, 1, 6, 5\)"),
        (lambda z: None, "returned NoneType"),
    ],
)
def test_what_predict_returns_is_checked(monkeypatch, returned, message):
    monkeypatch.setattr(Stub, "predict", lambda self, z, t, condition: returned(z))
    with pytest.raises(UserError, match=f"Stub.predict {message}"):
        step(Stub({"guidance_scale": 7.5}), uniform(4, 6, 5, 3))


def test_a_scale_without_an_unconditional_prediction_is_reported_once(caplog):
    guidance = Stub({"guidance_scale": 7.25})
    for _ in range(2):
        step(guidance, uniform(4, 6, 5, 3))
    assert caplog.text.count("guidance_scale=7.25 has no effect: Stub.predict returns no") == 1
