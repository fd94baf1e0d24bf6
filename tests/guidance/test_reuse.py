"""One prediction for several steps of the same views."""

import pytest
import torch

from tests.helpers.mixture_guidance import MixtureGuidance
from threestudio_gaussiandreamer.core.errors import UserError
from threestudio_gaussiandreamer.guidance.foreign import learnt_weights, restore_learnt

VARIANTS = ("sds-variant", "ism-variant", "vsd-variant")


def views(seed=0, count=2):
    generator = torch.Generator().manual_seed(seed)
    c2w = torch.rand(count, 4, 4, generator=generator)
    return {"c2w": c2w, "fovy": torch.ones(count), "comp_rgb_bg": torch.ones(count, 1, 3, 3)}


def renders(seed, count=2):
    """Return renders of one row of three pixels."""
    return torch.rand(count, 1, 3, 1, generator=torch.Generator().manual_seed(seed))


def reusing(variant="sds-variant", steps=3, **options):
    return MixtureGuidance({"variant_type": variant, "reuse_steps": steps, **options})


def gradient(guidance, step, rgb, batch):
    """Return the gradient of the latents, and the evaluations."""
    guidance.update_step(0, step)
    rgb = rgb.clone().requires_grad_()
    out = guidance(rgb, **batch)
    out["loss_sds"].backward()
    return rgb.grad, out["evaluations"]


@pytest.mark.parametrize("variant", VARIANTS)
def test_steps_of_the_same_views_follow_the_kept_target(variant):
    """With w = sqrt((1 - abar) / abar), the gradient is x minus the target."""
    options = {"guidance_scale": 7.5, "weighting_strategy": "x0"}
    guidance, plain = reusing(variant, **options), reusing(variant, steps=1, **options)
    first, second, batch = renders(1), renders(2), views()
    expected, asked = gradient(plain, 6, first, batch)
    fresh, evaluations = gradient(guidance, 6, first, batch)
    assert torch.equal(fresh, expected) and evaluations == asked > 0
    kept, evaluations = gradient(guidance, 7, second, batch)
    assert evaluations == 0
    # latents are 2 rgb - 1, and a batch of 2 is averaged
    torch.testing.assert_close(kept - fresh, 2 * 2 * (second - first) / 2, rtol=1e-4, atol=1e-5)


def test_other_views_or_too_many_steps_need_a_prediction_of_their_own():
    guidance, batch = reusing(), views()
    calls = [
        gradient(guidance, step, renders(step), others)[1] > 0
        for step, others in (
            *((step, batch) for step in range(4)),  # three steps, then a new one
            (4, batch | {"c2w": views(5)["c2w"]}),
            (5, batch | {"c2w": views(5)["c2w"], "comp_rgb_bg": torch.zeros(2, 1, 3, 3)}),
            (0, views(3)),
        )
    ]
    assert calls == [True, False, False, True, True, True, True]


def test_an_evaluation_neither_uses_nor_replaces_the_kept_prediction():
    guidance, batch = reusing(), views()
    gradient(guidance, 0, renders(0), batch)
    out = guidance(renders(9), guidance_eval=True, **views(8))
    assert out["evaluations"] > 0
    assert gradient(guidance, 1, renders(1), batch)[1] == 0


def test_a_resumed_guidance_goes_on_with_the_kept_prediction():
    batch, whole, resumed = views(), reusing("vsd-variant"), reusing("vsd-variant")
    gradient(whole, 3, renders(0), batch)
    state = {name: value.clone() for name, value in learnt_weights(whole).items()}
    restore_learnt(resumed, state)
    expected, _ = gradient(whole, 4, renders(1), batch)
    found, evaluations = gradient(resumed, 4, renders(1), batch)
    assert torch.equal(found, expected) and evaluations == 0
    other = reusing("sds-variant")
    with pytest.raises(UserError, match="another variant"):
        restore_learnt(other, state)


def test_a_prediction_that_isnt_finite_is_not_kept(monkeypatch):
    guidance, batch = reusing(), views()
    with monkeypatch.context() as patch:
        error = guidance.variant.error
        patch.setattr(
            guidance.variant, "error", lambda *args: (error(*args)[0] * torch.nan, error(*args)[1])
        )
        gradient(guidance, 0, renders(0), batch)
    found, evaluations = gradient(guidance, 1, renders(1), batch)
    assert evaluations > 0 and found.isfinite().all()


def test_no_process_keeps_a_prediction_if_that_of_another_isnt_finite(monkeypatch):
    guidance, batch = reusing(), views()
    monkeypatch.setattr("threestudio_gaussiandreamer.guidance.reuse.all_sum", lambda bad: bad + 1)
    assert [gradient(guidance, step, renders(step), batch)[1] > 0 for step in range(2)] == [
        True
    ] * 2


def test_several_processes_predict_in_the_same_steps_after_a_resume(monkeypatch):
    """A checkpoint has the first process's prediction only."""
    whole, resumed, batch = reusing(), reusing(), views()
    gradient(whole, 3, renders(0), batch)
    monkeypatch.setattr("threestudio_gaussiandreamer.guidance.reuse.world_size", lambda: 2)
    restore_learnt(resumed, learnt_weights(whole))
    assert gradient(resumed, 4, renders(1), batch)[1] > 0


def test_no_prediction_is_kept_by_default():
    guidance = reusing(steps=1)
    gradient(guidance, 0, renders(0), views())
    assert learnt_weights(guidance) == {}


def test_a_wrong_number_of_steps_is_named():
    with pytest.raises(UserError, match="reuse_steps"):
        reusing(steps=0)
