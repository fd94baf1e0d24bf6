"""View contrast: its formula, the timesteps it applies to, and the options it excludes."""

import pytest
import torch

from tests.helpers import tiny_guidance as tiny
from threestudio_gaussiandreamer.core.errors import UserError

pytest.importorskip("diffusers")

CONTRAST = 0.75
ALL = {"view_contrast": CONTRAST, "view_contrast_from": 0.0}
TURNED = tiny.BATCH | {"azimuth": tiny.BATCH["azimuth"] + 180}


@pytest.fixture(scope="module")
def z():
    return torch.randn(4, 4, 8, 8, generator=torch.Generator().manual_seed(0))


def predictions(models, prompt_utils, z, batch=tiny.BATCH, **options):
    """Return the conditional and the unconditional prediction of four views."""
    guide = tiny.guidance(models, guidance_scale=4.0, **options)
    guide.evaluations = 0
    return guide, *guide.predict(z, tiny.TIMESTEPS, guide.condition(prompt_utils, **batch))


def test_the_conditional_prediction_moves_away_from_the_opposite_views(models, prompts, z):
    _, plain, uncond = predictions(models, prompts[False], z)
    _, other, _ = predictions(models, prompts[False], z, TURNED)
    guide, cond, same = predictions(models, prompts[False], z, **ALL)
    torch.testing.assert_close(cond, plain + CONTRAST * (plain - other))
    torch.testing.assert_close(same, uncond)
    assert guide.evaluations == 12
    assert tiny.relative(cond[:1], plain[:1]) > 1e-3  # a front view


def test_only_at_large_timesteps(models, prompts, z):
    """TIMESTEPS are 40, 400, 700 and 950 of 1000."""
    _, plain, _ = predictions(models, prompts[False], z)
    _, everywhere, _ = predictions(models, prompts[False], z, **ALL)
    guide, cond, _ = predictions(models, prompts[False], z, view_contrast=CONTRAST)
    assert guide.evaluations == 8 + 3
    torch.testing.assert_close(cond[0], plain[0])
    torch.testing.assert_close(cond[1:], everywhere[1:])


def test_guidance_is_added_to_it(models, prompts, z):
    guide, cond, uncond = predictions(models, prompts[False], z, **ALL)
    condition = guide.condition(prompts[False], **tiny.BATCH)
    guided = guide.predict_noise(z, tiny.TIMESTEPS, condition)
    torch.testing.assert_close(guided, uncond + 4.0 * (cond - uncond))


def test_each_view_keeps_its_opposite_in_a_guidance_interval(models, prompts, z):
    """Views inside of the interval are those above timestep 500."""
    guide, _, _ = predictions(models, prompts[False], z, **ALL, guidance_interval=(0.5, 1.0))
    condition = guide.condition(prompts[False], **tiny.BATCH)
    got = guide.predict_noise(z, tiny.TIMESTEPS, condition)
    everywhere = tiny.guidance(models, guidance_scale=4.0, **ALL)
    expected = everywhere.predict_noise(z, tiny.TIMESTEPS, condition)
    torch.testing.assert_close(got[2:], expected[2:])


@pytest.mark.parametrize("variant", ["sds", "csd", "nfsd", "ism", "sdi"])
def test_variants_train_with_it(models, prompts, variant):
    guide = tiny.guidance(
        models, guidance_scale=4.0, variant_type=f"{variant}-variant", view_contrast=1.0
    )
    out = guide(tiny.renders(), prompts[False], **tiny.BATCH)
    assert out["loss_sds"].isfinite() and out["grad_norm"] > 0


def test_perp_neg_is_refused(models, prompts):
    guide = tiny.guidance(models, view_contrast=1.0)
    with pytest.raises(UserError, match="use_perp_neg=false"):
        guide.condition(prompts[True], **tiny.BATCH)


def test_the_same_prompt_for_all_views_is_refused(models):
    with pytest.raises(UserError, match="view_dependent_prompting=true"):
        tiny.guidance(models, view_contrast=1.0, view_dependent_prompting=False)
