"""The computation that all guidances share."""

import math

import pytest
import torch

from tests.guidance.conftest import step, uniform
from tests.helpers.refusals import refused
from threestudio_gaussiandreamer.core import streams
from threestudio_gaussiandreamer.diffusion import sds
from threestudio_gaussiandreamer.guidance.base import ScoreDistillation

pytest.importorskip("embreex")


class Stub(ScoreDistillation):
    """Predict the noise plus the latent, so that the gradient is w x."""

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
        return noise + x, None


def test_the_gradient_is_w_times_the_residual_and_evaluation_has_what_the_host_reads(monkeypatch):
    guidance, rgb = Stub({"guidance_scale": 1.0}), uniform(4, 6, 5, 3)
    out, grad = step(guidance, rgb)
    t = sds.timesteps(4, 20, 980, seed=0, step=0)
    weight = (1 - guidance.alphas_cumprod[t]).float().reshape(4, 1, 1, 1)
    # predict_x0 in float32 loses sigma/a = 13 times the rounding of z at t = 980
    torch.testing.assert_close(grad, 2 * weight * (2 * rgb - 1) / 4, rtol=0, atol=1e-5)
    assert (out["min_step"], out["max_step"], out["bad_items"]) == (20, 980, 0)
    torch.testing.assert_close(out["grad_norm"], (weight * (2 * rgb - 1)).norm(), rtol=1e-4, atol=0)
    monkeypatch.setenv("PL_GLOBAL_SEED", "5")
    assert not torch.equal(step(Stub({"guidance_scale": 1.0}), rgb)[1], grad)
    angles = {"elevation": torch.zeros(6), "azimuth": torch.tensor([0.0, 90, 180, -90, 0, 0])}
    batch = angles | {"camera_distances": torch.full((6,), 2.5)}
    out = Stub({})(uniform(6, 8, 6, 3), None, guidance_eval=True, **batch)["eval"]
    for name in ("imgs_noisy", "imgs_1step", "imgs_1orig", "imgs_final"):
        assert out[name].shape == (4, 8, 6, 3)
    assert out["bs"] == 4 and len(out["noise_levels"]) == len(out["texts"]) == 4
    assert out["texts"][1].split("\n")[1:] == ["e0.0", "a90.0", "c2.50"]


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
    refused(f"Stub.predict {message}", step, Stub({"guidance_scale": 7.5}), uniform(4, 6, 5, 3))


def test_a_scale_without_an_unconditional_prediction_is_reported_once(caplog):
    guidance = Stub({"guidance_scale": 7.25})
    for _ in range(2):
        step(guidance, uniform(4, 6, 5, 3))
    assert caplog.text.count("guidance_scale=7.25 has no effect: Stub.predict returns no") == 1
