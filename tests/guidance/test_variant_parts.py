"""Variants as parts: found by name, checked before any long work."""

import math

import pytest
import torch

from tests.guidance.conftest import guidance
from tests.helpers import tiny_guidance as tiny
from tests.helpers.pixel_guidance import MixtureGuidance, latents, mixture_guidance
from tests.helpers.refusals import refused
from threestudio_gaussiandreamer.core.errors import UserError
from threestudio_gaussiandreamer.guidance import exact_score, mvdream, stable_diffusion
from threestudio_gaussiandreamer.guidance.variants import Variant
from threestudio_gaussiandreamer.host import find, register
from threestudio_gaussiandreamer.launch.config_check import check_part


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"variant_type": "csd"}, "unknown variant 'csd': choose from cfd-var.*, csd-v"),
        ({"variant_type": "cds-variant"}, "guidance.variant_type: .*'csd-variant'"),
        ({"variant_type": "exact-score-guidance"}, "variant_type: .*choose from cfd-variant, csd-"),
        ({"variant": {"threshold": 0.1}}, "unknown key '.*variant.threshold'"),
        ({"variant_type": "sdi-variant", "variant": {"eat": 0.1}}, "did you mean '.*variant.eta'"),
        ({"variant_type": "vsd-variant", "variant": {"rank": 0}}, "variant.rank: expected a num"),
        ({"guidance_interval": [0.6, 0.4]}, "guidance_interval: expected"),
        ({"max_step_percent": 1.5}, "max_step_percent: expected values of 1 or less"),
        ({"mesh": ""}, "guidance.mesh"),
    ],
)
def test_bad_options_are_named_before_anything_is_built(mesh_path, options, message):
    with pytest.raises(UserError, match=message):
        check_part("system.guidance", "exact-score-guidance", {"mesh": mesh_path, **options})


def test_other_checkpoints_conditions_and_residuals_are_refused():
    guide = mixture_guidance()
    guide.variant.restore(guide, {})
    with pytest.raises(UserError, match="had learnt 1 tensors that aren't those"):
        guide.variant.restore(guide, {"mean": torch.zeros(3)})
    guide, x = mixture_guidance(guidance_interval=[0.3, 0.7]), latents(12)
    noised = guide.add_noise(x)
    with pytest.raises(UserError, match="MixtureGuidance has conditions of type dict: define its"):
        guide.predict_noise(noised.z, noised.t, {"azimuth": x})
    two, one, guide = torch.zeros(2, 3, 4, 5), torch.zeros(1, 3, 4, 5), mixture_guidance()
    for returned in (two, (one, torch.ones(2)), (two, torch.ones(1)), (two, 1), None):
        guide.variant.residual = lambda *_, returned=returned: returned
        refused("SDS.residual returned .*; expected the residual", guide, torch.zeros(2, 4, 5, 3))


class OneOfBoth(MixtureGuidance):
    """Counts one evaluation for the conditional score alone."""

    def conditional(self, z, t, condition):
        self.evaluations -= len(z)
        return super().conditional(z, t, condition)


def test_the_unconditional_score_is_skipped_outside_of_the_interval():
    guide = OneOfBoth({"guidance_scale": 7.5, "guidance_interval": [0.3, 0.7]})
    whole = MixtureGuidance({"guidance_scale": 7.5})
    plain = MixtureGuidance({"guidance_scale": 1.0})
    noised = guide.add_noise(latents(12))
    inside = (noised.t >= 300) & (noised.t <= 700)
    assert inside.any() and not inside.all()
    arguments = (noised.z, noised.t, None)
    eps = guide.predict_noise(*arguments)
    assert guide.evaluations == 12 + int(inside.sum())
    assert torch.equal(eps[inside], whole.predict_noise(*arguments)[inside])
    assert torch.equal(eps[~inside], plain.predict_noise(*arguments)[~inside])


def test_conditions_are_selected_by_view_and_an_empty_negative_prompt_is_no_other(models, prompts):
    """The noise of two of four views, selected, is that of all four at these views."""
    pytest.importorskip("diffusers")
    guide = tiny.guidance(models, guidance_scale=7.5)
    for perp_neg in (False, True):
        condition = guide.condition(prompts[perp_neg], **tiny.BATCH)
        z = torch.randn(4, 4, 8, 8, generator=torch.Generator().manual_seed(0))
        rows = torch.tensor([3, 1])
        selected = guide.predict_noise(z[rows], tiny.TIMESTEPS[rows], guide.select(condition, rows))
        whole = guide.predict_noise(z, tiny.TIMESTEPS, condition)
        # other batch sizes round differently, and the scale magnifies it
        torch.testing.assert_close(selected, whole[rows], rtol=0, atol=1e-4)
    pytest.importorskip("diffusers")
    options = {"pretrained_model_name_or_path": str(models["epsilon"]), "prompt": "a fox"}
    guide = tiny.guidance(models, variant_type="nfsd-variant")
    for negative in ("ugly", ""):
        prompt_utils = find("gaussiandreamer-stable-diffusion-prompt-processor")(
            options | {"negative_prompt": negative, "use_cache": False}
        )()
        is_other = guide.condition(prompt_utils, **tiny.BATCH).empty is not None
        assert is_other == bool(negative)


@pytest.mark.parametrize("variant", ["sds", "ism", "sdi"])
def test_without_guidance_the_last_prediction_is_of_one_prompt(models, prompts, variant):
    pytest.importorskip("diffusers")
    found = {}
    for scale in (1.0, 1.5):
        guide = tiny.guidance(models, guidance_scale=scale, variant_type=f"{variant}-variant")
        found[scale] = tiny.gradient(guide, prompts[False], tiny.renders())[1]["evaluations"]
    assert found[1.5] - found[1.0] == 4


@register("test-none-variant")
class NoResidual(Variant):
    pass


@register("test-other-variant")
class OtherResidual(Variant):
    def residual(self, guidance, latents):
        return latents


def test_a_variant_without_the_method_residual_is_refused_and_its_old_name_works(mesh_path, caplog):
    called = r".*\(guidance, latents, condition, batch\)"
    with pytest.raises(UserError, match=f"NoResidual has no residual{called}"):
        guidance(mesh_path, variant_type="test-none-variant")
    with pytest.raises(UserError, match=f"OtherResidual has residual.*called as{called}"):
        guidance(mesh_path, variant_type="test-other-variant")

    class Named(Variant):
        def error(self, guidance, latents, condition, batch):
            return 0.25 * latents, torch.ones(len(latents))

    assert "Named.error is called residual now" in caplog.text
    residual, _ = Named({}).residual(None, latents(), None, {})
    assert torch.equal(residual, 0.25 * latents())


NOISIEST = {"min_step_percent": 0.98, "max_step_percent": 0.98}


def test_an_inversion_takes_at_most_its_share_of_the_steps(monkeypatch):
    seen = []

    def guided_noise(self, z, t, condition, scale, **options):
        seen.append(t.tolist())
        return torch.zeros_like(z)

    monkeypatch.setattr(MixtureGuidance, "guided_noise", guided_noise)
    for steps, stride in ((1, 1000), (10, 100), (300, 4)):
        seen.clear()
        own = {"inversion_steps": steps, "eta": 0.0}
        guide, x = mixture_guidance("sdi-variant", variant=own, **NOISIEST), latents(1)
        guide.variant.residual(guide, x, None, {})
        *inversion, last = seen
        assert last == [980] and inversion == [[t] for t in range(0, 980, stride)]
        assert len(inversion) <= math.ceil(0.98 * steps)


@pytest.mark.parametrize(
    ("given", "more", "said"),
    [
        ({"variant_type": "csd-variant"}, {"mode": "view-agnostic"}, "csd-variant follows the dif"),
        ({"variant_type": "csd-variant"}, {"guidance_interval": [0.2, 0.8]}, "interval has no ef"),
        ({"variant_type": "nfsd-variant"}, {"recon_std_rescale": 0.5}, "rescale has no effect"),
        ({"guidance_scale": 1.0}, {"guidance_interval": [0.2, 0.8]}, "interval has no effect with"),
        ({"guidance_scale": 1.0}, {"recon_std_rescale": 0.5}, "effect with guidance_scale=1"),
    ],
)
def test_what_has_no_effect_is_refused_before_long_work(mesh_path, given, more, said):
    options = {"mesh": mesh_path, "mode": "direction-bins", "guidance_scale": 7.5}
    off = {"guidance_interval": [0, 1], "recon_std_rescale": 0.0}
    exact_score.ExactScoreGuidance.preflight(options | given | off)
    exact_score.ExactScoreGuidance.preflight(options | more)
    refused(said, exact_score.ExactScoreGuidance.preflight, options | given | more)


@pytest.mark.parametrize("more", [{"guidance_scale": 1.0}, {"variant_type": "csd-variant"}])
def test_defaults_without_effect_are_not_refused(models, large, more):
    """MVDream's ``recon_std_rescale`` is 0.5 unless given."""
    pytest.importorskip("diffusers")
    mine = {"pretrained_model_name_or_path": str(large("mvdream")[0])} | more
    for given in ({}, {"recon_std_rescale": 0.0}, {"recon_std_rescale": 0.5}):
        mvdream.MVDreamGuidance.preflight(mine | given)
    with pytest.raises(UserError, match="recon_std_rescale has no effect .*: leave it at 0.5"):
        mvdream.MVDreamGuidance.preflight(mine | {"recon_std_rescale": 0.3})


def test_an_interval_without_guidance_limits_a_view_contrast(models):
    """It is not refused, and neither is it for Perp-Neg, which the guidance isn't told of."""
    pytest.importorskip("diffusers")
    options = {"guidance_scale": 1.0, "guidance_interval": [0.2, 0.8]}
    options["pretrained_model_name_or_path"] = str(models["epsilon"])
    stable_diffusion.StableDiffusionGuidance.preflight(options | {"view_contrast": 1.5})
    stable_diffusion.StableDiffusionGuidance.preflight(options)
    with pytest.raises(UserError, match="recon_std_rescale has no effect with guidance_scale=1"):
        stable_diffusion.StableDiffusionGuidance.preflight(options | {"recon_std_rescale": 0.5})
