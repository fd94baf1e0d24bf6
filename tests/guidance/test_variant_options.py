"""Options of variants that limit their cost, and options that are refused for having no effect."""

import math

import pytest
import torch

from tests.helpers import tiny_large_models
from tests.helpers.mixture_guidance import MixtureGuidance, latents, mixture_guidance
from threestudio_gaussiandreamer.core.errors import UserError
from threestudio_gaussiandreamer.guidance.exact_score import ExactScoreGuidance
from threestudio_gaussiandreamer.guidance.mvdream import MVDreamGuidance
from threestudio_gaussiandreamer.guidance.stable_diffusion import StableDiffusionGuidance

NOISIEST = {"min_step_percent": 0.98, "max_step_percent": 0.98}


@pytest.mark.parametrize(("steps", "stride"), [(1, 1000), (10, 100), (300, 4), (1000, 1)])
def test_an_inversion_takes_at_most_its_share_of_the_steps(steps, stride, monkeypatch):
    seen = []

    def guided_noise(self, z, t, condition, scale, **options):
        seen.append(t.tolist())
        return torch.zeros_like(z)

    monkeypatch.setattr(MixtureGuidance, "guided_noise", guided_noise)
    own = {"inversion_steps": steps, "eta": 0.0}
    guide, x = mixture_guidance("sdi-variant", variant=own, **NOISIEST), latents(1)
    guide.variant.residual(guide, x, None, {})
    *inversion, last = seen
    assert last == [980] and inversion == [[t] for t in range(0, 980, stride)]
    assert len(inversion) <= math.ceil(0.98 * steps)


def exact_score(mesh_path, **options):
    return {"mesh": mesh_path, "mode": "direction-bins", "guidance_scale": 7.5, **options}


def test_csd_without_its_factor_is_refused_before_long_work(mesh_path):
    options = exact_score(mesh_path, variant_type="csd-variant")
    with pytest.raises(UserError, match="guidance_scale: .*csd-variant.* zero with 0: set it to"):
        ExactScoreGuidance.preflight(options | {"guidance_scale": 0.0})
    ExactScoreGuidance.preflight(options)
    ExactScoreGuidance.preflight(options | {"variant_type": "sds-variant", "guidance_scale": 0.0})


@pytest.mark.parametrize(
    "option", [{"guidance_interval": [0.2, 0.8]}, {"recon_std_rescale": 0.5}], ids=str
)
def test_options_of_guidance_without_guidance_are_refused(mesh_path, option):
    options = exact_score(mesh_path, **option)
    with pytest.raises(
        UserError, match=f"{next(iter(option))} has no effect with guidance_scale=1"
    ):
        ExactScoreGuidance.preflight(options | {"guidance_scale": 1.0})
    ExactScoreGuidance.preflight(options)


def test_the_defaults_are_not_refused_without_guidance(mesh_path):
    given = {"guidance_scale": 1.0, "guidance_interval": [0, 1], "recon_std_rescale": 0.0}
    ExactScoreGuidance.preflight(exact_score(mesh_path, **given))


@pytest.mark.parametrize(
    "option", [{"rank": 8}, {"lr": 1e-3}, {"samples": 2}, {"camera_dropout": 0.5}], ids=str
)
def test_options_of_a_lora_are_refused_without_one(mesh_path, option):
    options = exact_score(mesh_path, variant_type="vsd-variant")
    name = f"system.guidance.variant.{next(iter(option))}"
    with pytest.raises(UserError, match=f"{name} has no effect with ExactScoreGuidance: leave it"):
        ExactScoreGuidance.preflight(options | {"variant": option})
    ExactScoreGuidance.preflight(options | {"variant": {"rank": 4, "momentum": 0.5}})


def test_the_default_of_mvdream_is_not_refused_without_guidance(tmp_path):
    """Its ``recon_std_rescale`` is 0.5 unless given."""
    pytest.importorskip("diffusers")
    folder = str(tiny_large_models.mvdream(tmp_path))
    options = {"pretrained_model_name_or_path": folder, "guidance_scale": 1.0}
    for share in (None, 0.0, 0.5):
        given = {} if share is None else {"recon_std_rescale": share}
        MVDreamGuidance.preflight(options | given)
    with pytest.raises(UserError, match="recon_std_rescale has no effect .*: leave it at 0.5"):
        MVDreamGuidance.preflight(options | {"recon_std_rescale": 0.3})
    with pytest.raises(UserError, match="guidance_interval has no effect with guidance_scale=1"):
        MVDreamGuidance.preflight(options | {"guidance_interval": [0.2, 0.8]})


def diffusion(models, **options):
    return {"pretrained_model_name_or_path": str(models["epsilon"]), **options}


def test_a_lora_has_no_momentum(models):
    pytest.importorskip("diffusers")
    options = diffusion(models, variant_type="vsd-variant")
    with pytest.raises(UserError, match="variant.momentum has no effect with StableDiffusionGuid"):
        StableDiffusionGuidance.preflight(options | {"variant": {"momentum": 0.5}})
    StableDiffusionGuidance.preflight(options | {"variant": {"rank": 8, "momentum": 0.95}})


def test_an_interval_without_guidance_limits_a_view_contrast(models):
    """It is not refused, and neither is it for Perp-Neg, which the guidance isn't told of."""
    pytest.importorskip("diffusers")
    options = diffusion(models, guidance_scale=1.0, guidance_interval=[0.2, 0.8])
    StableDiffusionGuidance.preflight(options | {"view_contrast": 1.5})
    StableDiffusionGuidance.preflight(options)
    with pytest.raises(UserError, match="recon_std_rescale has no effect with guidance_scale=1"):
        StableDiffusionGuidance.preflight(options | {"recon_std_rescale": 0.5})
