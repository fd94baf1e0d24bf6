"""View contrast: its formula, the timesteps it applies to, and the options it excludes."""

import pytest
import torch

from tests.helpers import tiny_guidance as tiny
from threestudio_gaussiandreamer.core.errors import UserError
from threestudio_gaussiandreamer.guidance import mvdream  # noqa: F401
from threestudio_gaussiandreamer.host import find

pytest.importorskip("diffusers")

CONTRAST = 0.75
BATCH = tiny.BATCH | {"elevation": torch.tensor([0.0, 10.0, 20.0, -5.0])}
"""Front, left, back and right."""
TURNED = BATCH | {"azimuth": BATCH["azimuth"] + 180}


@pytest.fixture(scope="module")
def views(models):
    return tiny.left_and_right(models)


@pytest.fixture(scope="module")
def z():
    return torch.randn(4, 4, 8, 8, generator=torch.Generator().manual_seed(0))


def test_the_conditional_prediction_moves_away_from_the_opposite_views(models, views, z):
    """Of timesteps 40, 400, 700 and 950 of 1000 at those from 400 on."""

    def predictions(batch, contrast):
        guide = tiny.guidance(models, guidance_scale=4.0, view_contrast=contrast)
        guide.evaluations = 0
        return guide, *guide.predict(z, tiny.TIMESTEPS, guide.condition(views, **batch))

    _, plain, uncond = predictions(BATCH, 0.0)
    _, other, _ = predictions(TURNED, 0.0)
    guide, cond, same = predictions(BATCH, CONTRAST)
    torch.testing.assert_close(cond[1:], (plain + CONTRAST * (plain - other))[1:])
    torch.testing.assert_close(cond[0], plain[0])
    torch.testing.assert_close(same, uncond)
    assert guide.evaluations == 8 + 3
    assert all(tiny.relative(*pair) > 1e-3 for pair in zip(cond[1:], plain[1:], strict=True))
    options = {"guidance_scale": 4.0, "view_contrast": CONTRAST}
    guide = tiny.guidance(models, **options, guidance_interval=(0.5, 1.0))
    condition = guide.condition(views, **BATCH)
    got = guide.predict_noise(z, tiny.TIMESTEPS, condition)
    expected = tiny.guidance(models, **options).predict_noise(z, tiny.TIMESTEPS, condition)
    torch.testing.assert_close(got[2:], expected[2:])
    plain = guide.conditional(z, tiny.TIMESTEPS, condition)
    torch.testing.assert_close(got[:2], plain[:2])


def test_what_has_one_prompt_for_all_views_refuses_it(models):
    with pytest.raises(UserError, match="one prompt for all views"):
        find("gaussiandreamer-mvdream-guidance")({"view_contrast": 1.0})
    with pytest.raises(UserError, match="view_dependent_prompting=true"):
        tiny.guidance(models, view_contrast=1.0, view_dependent_prompting=False)
