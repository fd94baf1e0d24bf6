"""Options of the exact score that are refused because they have no effect, or contradict."""

import pytest

from threestudio_gaussiandreamer.core.errors import UserError
from threestudio_gaussiandreamer.guidance import exact_score
from threestudio_gaussiandreamer.guidance.exact_score import ExactScoreGuidance

BANK = {"mesh": "toy.glb", "mode": "direction-bins", "guidance_scale": 7.5}


def test_options_of_latents_are_refused_in_pixels():
    option = {"latent_size": 16}
    with pytest.raises(UserError, match="latent_size has no effect with space=pixel"):
        ExactScoreGuidance.preflight(BANK | option)
    ExactScoreGuidance.preflight(BANK | option | {"space": "latent"})


@pytest.mark.parametrize("used", [{"mode": "view-agnostic"}, {"guidance_scale": 2.0}], ids=str)
@pytest.mark.parametrize(
    "option", [{"bank_views": 12}, {"bank_includes_view": False}, {"bank_fovy_range": [40, 50]}]
)
def test_options_of_the_bank_are_refused_where_none_is_cast(option, used):
    without = {"mesh": "toy.glb", "mode": "view-exact", "guidance_scale": 1.0}
    with pytest.raises(UserError, match=f"{next(iter(option))} has no effect .* without a bank"):
        ExactScoreGuidance.preflight(without | option)
    ExactScoreGuidance.preflight(without | option | used)
    ExactScoreGuidance.preflight(without | option | {"space": "latent"})
    ExactScoreGuidance.preflight(without | {"bank_seed": 3})


def test_a_picture_that_cant_be_pooled_to_the_latent_is_refused_before_the_mesh_is_read():
    options = BANK | {"mesh": "no.glb", "space": "latent", "latent_size": 33}
    with pytest.raises(UserError, match="pictures of 64x64 can't be pooled to a latent 33 high"):
        ExactScoreGuidance(options | {"image_size": 64})
    ExactScoreGuidance.preflight(options | {"mesh": "toy.glb", "image_size": 66})


def test_guidance_without_a_direction_is_warned_of(monkeypatch):
    messages = []
    monkeypatch.setattr(exact_score, "warn", messages.append)
    ExactScoreGuidance.preflight(BANK)
    ExactScoreGuidance.preflight(BANK | {"mode": "view-agnostic", "guidance_scale": 1.0})
    assert not messages
    ExactScoreGuidance.preflight(BANK | {"mode": "view-agnostic"})
    assert "guidance_scale has no effect with mode=view-agnostic" in messages[0]
