import math

import pytest
import torch

from tests.diffusion.test_exact_score import denoised
from threestudio_gaussiandreamer.core.errors import UserError
from threestudio_gaussiandreamer.diffusion import sds

ABAR = sds.sd_alphas_cumprod()


def test_the_schedule_is_stable_diffusions_and_predictions_are_converted_to_the_noise():
    assert ABAR.dtype == torch.float64 and len(ABAR) == 1000
    # Published figures of the scaled-linear schedule: sigma_0 = .029, sqrt(abar/(1-abar)) = 7.2 at
    # t = 20 and .077 at 980.
    assert math.isclose((1 - ABAR[0]).sqrt(), 0.0292, abs_tol=1e-4)
    ratio = (ABAR / (1 - ABAR)).sqrt()
    assert math.isclose(ratio[20], 7.2, abs_tol=0.05) and math.isclose(
        ratio[980], 0.077, abs_tol=5e-4
    )
    x, eps = torch.randn(2, 3, 5, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    abar = ABAR[torch.tensor([20, 500, 980])]
    a, sigma = abar.sqrt()[:, None], (1 - abar).sqrt()[:, None]
    outputs = {"epsilon": eps, "v_prediction": a * eps - sigma * x, "sample": x}
    outputs["velocity"] = eps - x
    assert outputs.keys() == sds.PREDICTIONS.keys()
    for name, output in outputs.items():
        found = sds.PREDICTIONS[name](output, a * x + sigma * eps, abar)
        torch.testing.assert_close(found, eps, rtol=0, atol=1e-12)


def test_timesteps_cover_the_valid_range_and_stratified_ones_lie_one_in_each_part():
    cases = [(0.02, 0.98, 20, 980), (0.0, 1.0, 1, 999), (1.0, 1.0, 999, 999), (0.02, 0.55, 20, 550)]
    for low, high, first, last in cases:
        assert sds.step_range(low, high) == (first, last)
    with pytest.raises(UserError, match="min_step_percent: 0.5 is above"):
        sds.step_range(0.5, 0.4)
    for low, high, last in ((20, 27, 27), (0, 10, 4)):
        options = {"seed": 0, "num_train": 1000 if low else 5}
        draws = torch.cat([sds.timesteps(8, low, high, step=step, **options) for step in range(99)])
        assert set(draws.tolist()) == set(range(max(low, 1), last + 1))
    rng, batch = torch.Generator().manual_seed(3), 7
    draws = torch.stack([sds.stratified_timesteps(batch, 1000, rng) for _ in range(200)])
    low, high = torch.arange(batch) * 1000 // batch, (torch.arange(batch) + 1) * 1000 / batch
    ordered = draws.sort(1).values
    assert (ordered >= low).all() and (ordered <= high).all()
    assert draws.min() < 20 and draws.max() > 980 and (draws[:, 0] != draws[0, 0]).any()


def test_weights_guidance_loss_and_ddim_by_their_formulas():
    quarter = torch.tensor([0.25], dtype=torch.float64)
    for name, value in {"sds": 0.75, "uniform": 1.0, "fantasia3d": 0.375}.items():
        assert sds.WEIGHTS[name](quarter).item() == value
    cond, uncond = torch.tensor([2.0]), torch.tensor([1.0])
    for scale, expected in ((1.0, cond), (0.0, uncond), (101.0, cond + 100 * (cond - uncond))):
        assert sds.classifier_free(cond, uncond, scale) == expected  # threestudio's 100 is 101
    x, grad = torch.randn(2, 4, 3, 8, 8, generator=torch.Generator().manual_seed(0))
    loss = sds.sds_loss(x.requires_grad_(), grad)
    (found,) = torch.autograd.grad(loss, x)
    torch.testing.assert_close(found, grad / 4)
    torch.testing.assert_close(loss.detach(), 0.5 * grad.square().sum() / 4)
    point = torch.randn(1, 5, generator=torch.Generator().manual_seed(0), dtype=torch.float64)

    def predict(z, t):
        abar = ABAR[t]
        return (z - sds.per_item(abar.sqrt(), z) * point) / sds.per_item((1 - abar).sqrt(), z)

    z = torch.randn(3, 5, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    for steps in (1, 7, 50):
        out = sds.ddim_sample(predict, z, torch.tensor([3, 500, 980]), ABAR, steps=steps)
        torch.testing.assert_close(out, point.expand(3, 5), rtol=0, atol=1e-11)


SIGMA = torch.tensor([0.002, 0.3, 0.6, 0.95, 0.999], dtype=torch.float64)


def randn(*shape, seed=0):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def test_a_noisy_latent_lies_on_the_straight_path_of_diffusers_sigmas():
    x, eps = randn(2, 5, 7)
    abar = sds.abar_of_sigma(SIGMA)
    torch.testing.assert_close(sds.sigma_of_abar(abar), SIGMA)
    torch.testing.assert_close(((1 - abar) / abar).sqrt(), SIGMA / (1 - SIGMA))
    ends = torch.tensor([0.0, 1.0], dtype=torch.float64)
    assert sds.abar_of_sigma(ends).tolist() == [1.0, 0.0]
    assert sds.sigma_of_abar(1 - ends).tolist() == [0.0, 1.0]
    z = sds.diffuse(x, eps, abar)
    path = (1 - SIGMA)[:, None] * x + SIGMA[:, None] * eps
    torch.testing.assert_close(sds.on_path(z, abar), path)
    torch.testing.assert_close(sds.noise_of_velocity(eps - x, z, abar), eps)
    x, eps, guess = randn(3, 5, 7)
    abar = sds.abar_of_sigma(SIGMA)
    z = sds.diffuse(x, eps, abar)
    torch.testing.assert_close(sds.predict_x0(z, eps, abar), x)
    grad = sds.per_item(sds.WEIGHTS["x0"](abar), eps) * (guess - eps)
    torch.testing.assert_close(grad, x - sds.predict_x0(z, guess, abar), rtol=1e-9, atol=1e-9)
    scheduler = pytest.importorskip("diffusers").FlowMatchEulerDiscreteScheduler(shift=3.0)
    sigmas = sds.shifted_sigmas(1000, 3.0)
    # theirs are in decreasing order and end at timestep 1
    torch.testing.assert_close(
        scheduler.sigmas.flip(0)[:-1].double(), sigmas[1:], rtol=1e-6, atol=0
    )
    assert sigmas[0] == 0 and (sigmas.diff() > 0).all()


@pytest.mark.parametrize("sigma", [0.05, 0.5, 0.95])
def test_a_mixtures_velocity_is_its_score(sigma):
    """The velocity's posterior, in the flow's own variables, against the exact score."""
    centers, shares = randn(4, 3), torch.tensor([0.1, 0.2, 0.3, 0.4]).double()
    level = torch.tensor([sigma], dtype=torch.float64)
    abar = sds.abar_of_sigma(level)
    z = randn(1, 3, seed=1)
    eps, _ = denoised(z, abar, centers, shares.log()[None])
    on_path = sds.on_path(z, abar)
    gaps = (on_path - (1 - sigma) * centers).square().sum(1)
    x0 = torch.softmax(shares.log() - gaps / (2 * sigma**2), 0) @ centers
    found = sds.noise_of_velocity((on_path - x0) / sigma, z, abar)  # E[eps - x | z]
    torch.testing.assert_close(found, eps, rtol=1e-9, atol=1e-9)
