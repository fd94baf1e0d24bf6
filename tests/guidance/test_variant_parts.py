"""Variants as parts: found by registered name, checked before any long work, the same for every
guidance.
"""

from dataclasses import dataclass, field

import pytest
import torch
from omegaconf import OmegaConf

from tests.guidance.exact_score_cases import batch, guidance, step, uniform
from tests.helpers import tiny_guidance as tiny
from tests.helpers.mixture_guidance import MixtureGuidance, latents, mixture_guidance
from threestudio_gaussiandreamer.core.errors import UserError
from threestudio_gaussiandreamer.core.options import positive
from threestudio_gaussiandreamer.guidance.exact_score import ExactScoreGuidance
from threestudio_gaussiandreamer.guidance.variants import Variant
from threestudio_gaussiandreamer.host import find, names, register
from threestudio_gaussiandreamer.launch.config_check import check_part

VARIANTS = [
    name for name in names() if name.endswith("-variant") and issubclass(find(name), Variant)
]


def test_all_variants_are_registered():
    wanted = {"sds", "csd", "nfsd", "vsd", "sdi", "ism", "cfd"}
    assert set(VARIANTS) == {f"{name}-variant" for name in wanted}


def surface(size=16, views=2):
    """Return the renderer's outputs of a wall two units away."""
    return {
        "depth": torch.full((views, size, size, 1), 2.0),
        "opacity": torch.ones(views, size, size, 1),
    }


@pytest.mark.parametrize("variant", VARIANTS)
def test_every_variant_works_with_the_exact_score(mesh_path, variant):
    guide = guidance(
        mesh_path,
        mode="direction-bins",
        space="latent",
        latent_size=4,
        guidance_scale=7.5,
        variant_type=variant,
    )
    for at in range(2):
        guide.update_step(0, at)
        out, grad = step(guide, uniform(2, 16, 16, 3), **batch(0.0, 120.0), **surface())
        assert grad.isfinite().all() and grad.abs().max() > 0 and out["bad_items"] == 0
        assert out["evaluations"] >= 4


@pytest.mark.parametrize("variant", VARIANTS)
@pytest.mark.parametrize("perp_neg", [False, True])
def test_every_variant_works_with_a_diffusion_model(models, prompts, variant, perp_neg):
    pytest.importorskip("diffusers")
    guide = tiny.guidance(models, guidance_scale=7.5, variant_type=variant)
    rgb, views = tiny.renders(2), {"c2w": torch.eye(4).repeat(2, 1, 1), "fovy": torch.ones(2)}
    out = guide(rgb, prompts[perp_neg], **tiny.first(2), **views, **surface())
    (grad,) = torch.autograd.grad(out["loss_sds"], rgb)
    assert grad.isfinite().all() and grad.abs().max() > 0


def test_a_variant_of_a_user_is_one_file():
    @register("test-half-variant")
    class Half(Variant):
        @dataclass
        class Config(Variant.Config):
            share: float = field(default=0.5, metadata=positive())

        def residual(self, guidance, latents, condition, batch):
            noised = guidance.add_noise(latents)
            return self.cfg.share * latents, noised.abar

    guide = mixture_guidance("test-half-variant", variant={"share": 0.25})
    error, _ = guide.variant.residual(guide, latents(), None, {})
    assert torch.equal(error, 0.25 * latents())
    with pytest.raises(UserError, match="system.guidance.variant.share: expected a number above 0"):
        mixture_guidance("test-half-variant", variant={"share": 0.0})


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (
            {"variant_type": "csd"},
            "variant_type: unknown variant 'csd': choose from cfd-var.*, csd-v",
        ),
        ({"variant_type": "cds-variant"}, "guidance.variant_type: .*'csd-variant'"),
        ({"variant_type": "exact-score-guidance"}, "variant_type: .*choose from cfd-variant, csd-"),
        ({"variant": {"threshold": 0.1}}, "unknown key '.*variant.threshold'"),
        (
            {"variant_type": "ism-variant", "variant": {"intervals": 0.1}},
            "did you mean '.*variant.interval'",
        ),
        (
            {"variant_type": "vsd-variant", "variant": {"rank": 0}},
            "guidance.variant.rank: expected a number from 1",
        ),
        ({"guidance_interval": [0.6, 0.4]}, "guidance_interval: expected"),
        ({"recon_std_rescale": 1.5}, "recon_std_rescale: expected a number from 0 to 1"),
    ],
)
def test_bad_options_are_named_before_anything_is_built(mesh_path, options, message):
    with pytest.raises(UserError, match=message):
        check_part("system.guidance", "exact-score-guidance", {"mesh": mesh_path, **options})


def test_a_variant_without_a_gradient_is_refused_before_long_work(mesh_path):
    options = {"mesh": mesh_path, "mode": "view-agnostic", "variant_type": "csd-variant"}
    with pytest.raises(UserError, match="csd-variant follows the difference"):
        ExactScoreGuidance.preflight(options)
    ExactScoreGuidance.preflight(options | {"mode": "direction-bins"})


@pytest.mark.parametrize("variant", ["csd-variant", "nfsd-variant"])
@pytest.mark.parametrize(
    "option", [{"guidance_interval": [0.2, 0.8]}, {"recon_std_rescale": 0.5}], ids=str
)
def test_options_without_effect_are_refused(mesh_path, variant, option):
    options = {"mesh": mesh_path, "mode": "direction-bins", "variant_type": variant}
    with pytest.raises(UserError, match=f"{next(iter(option))} has no effect with {variant}"):
        ExactScoreGuidance.preflight(options | option)
    ExactScoreGuidance.preflight(options)


def test_surface_noise_without_a_surface_is_an_error():
    guide = mixture_guidance("cfd-variant")
    with pytest.raises(UserError, match="give the guidance the renderer's depth and opacity"):
        guide.variant.residual(guide, latents(), None, {})


def test_a_checkpoint_of_another_variant_is_refused():
    guide = mixture_guidance()
    guide.variant.restore(guide, {})
    with pytest.raises(UserError, match="1 tensors of another variant"):
        guide.variant.restore(guide, {"mean": torch.zeros(3)})


# The shared options
# --------------------------------------------------------------------------------------------------


class Counting(MixtureGuidance):
    """Records how many items are asked for with and without the unconditional score."""

    def __init__(self, *args):
        self.asked = []
        super().__init__(*args)

    def predict(self, z, t, condition):
        self.asked.append(("both", len(z)))
        return super().predict(z, t, condition)

    def conditional(self, z, t, condition):
        self.asked.append(("conditional", len(z)))
        return super().predict(z, t, condition)[0]


def test_the_unconditional_score_is_skipped_outside_of_the_interval():
    guide = Counting({"guidance_scale": 7.5, "guidance_interval": [0.3, 0.7]})
    whole = MixtureGuidance({"guidance_scale": 7.5})
    plain = MixtureGuidance({"guidance_scale": 1.0})
    x = latents(12)
    noised = guide.add_noise(x)
    inside = (noised.t >= 300) & (noised.t <= 700)
    assert inside.any() and not inside.all()
    arguments = (noised.z, noised.t, None)
    eps = guide.predict_noise(*arguments)
    assert guide.asked == [("both", int(inside.sum())), ("conditional", int((~inside).sum()))]
    assert torch.equal(eps[inside], whole.predict_noise(*arguments)[inside])
    assert torch.equal(eps[~inside], plain.predict_noise(*arguments)[~inside])


def test_the_conditions_of_a_diffusion_model_are_selected_by_view(models, prompts):
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


def test_the_empty_prompt_is_encoded_for_the_variant_that_needs_it(models, prompts):
    pytest.importorskip("diffusers")
    nfsd, sds = (
        tiny.guidance(models, variant_type=f"{name}-variant").condition(
            prompts[False], **tiny.BATCH
        )
        for name in ("nfsd", "sds")
    )
    assert sds.empty is None and torch.equal(nfsd.embeddings, sds.embeddings)
    assert nfsd.empty.shape == (1, *nfsd.embeddings.shape[1:])
    assert not any(torch.equal(nfsd.empty[0], embedding) for embedding in nfsd.embeddings)


def test_an_empty_negative_prompt_is_the_empty_prompt(models):
    """It isn't evaluated a second time."""
    pytest.importorskip("diffusers")
    folder = models["epsilon"]
    evaluations = []
    for negative in ("ugly", ""):
        prompt_utils = find("gaussiandreamer-stable-diffusion-prompt-processor")(
            {"pretrained_model_name_or_path": str(folder), "prompt": "a fox"}
            | {"negative_prompt": negative, "use_cache": False}
        )()
        guide = tiny.guidance(models, variant_type="nfsd-variant")
        _, out = tiny.gradient(guide, prompt_utils, tiny.renders())
        evaluations.append(out["evaluations"])
    assert evaluations == [3 * 4, 2 * 4]


@pytest.mark.parametrize("variant, evaluations", [("sds", 4), ("ism", 4), ("sdi", 4)])
def test_without_guidance_the_last_prediction_is_of_one_prompt(
    models, prompts, variant, evaluations
):
    pytest.importorskip("diffusers")
    found = {}
    for scale in (1.0, 1.5):
        options = {"guidance_scale": scale, "variant_type": f"{variant}-variant"}
        guide = tiny.guidance(models, **options)
        _, out = tiny.gradient(guide, prompts[False], tiny.renders())
        found[scale] = out["evaluations"]
    assert found[1.5] - found[1.0] == evaluations


def test_a_guidance_with_its_own_conditions_must_say_how_to_select_them():
    guide, x = mixture_guidance(guidance_interval=[0.3, 0.7]), latents(12)
    noised = guide.add_noise(x)
    with pytest.raises(UserError, match="MixtureGuidance has conditions of type dict: define its"):
        guide.predict_noise(noised.z, noised.t, {"azimuth": x})


def test_the_contrast_is_rescaled_for_every_guidance():
    """With the full rescaling the guided x0 has the deviation of the conditional one."""
    guide = mixture_guidance(guidance_scale=30.0, recon_std_rescale=1.0)
    x = latents()
    noised = guide.add_noise(x)
    a, sigma = (v.sqrt().reshape(-1, 1, 1, 1) for v in (noised.abar, 1 - noised.abar))
    rescaled, cond = (
        ((noised.z - sigma * eps) / a).std(dim=(1, 2, 3))
        for eps in (
            guide.predict_noise(noised.z, noised.t, None),
            guide.conditional(noised.z, noised.t, None),
        )
    )
    torch.testing.assert_close(rescaled, cond)


@pytest.mark.parametrize(
    "returned",
    [
        torch.zeros(2, 3, 4, 5),
        (torch.zeros(1, 3, 4, 5), torch.ones(2)),
        (torch.zeros(2, 3, 4, 5), torch.ones(1)),
        (torch.zeros(2, 3, 4, 5), 0.5),
        None,
    ],
)
def test_what_a_variant_returns_has_the_latents_shape(returned):
    """Broadcast, an error of one item would train all others with it."""
    latents = torch.zeros(2, 3, 4, 5)
    right = (torch.zeros_like(latents), torch.ones(2))
    variant = find("sds-variant")({})
    assert variant.checked(right, latents) is right
    with pytest.raises(UserError, match=r"SDS.residual returned \(.*; expected the residual and"):
        variant.checked(returned, latents)


@register("test-errorless-variant")
class Errorless(Variant):
    pass


@register("test-other-error-variant")
class OtherError(Variant):
    def residual(self, guidance, latents):
        return latents


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("errorless", "Errorless has no residual"),
        ("other-error", "OtherError has residual.*called as"),
    ],
)
def test_a_variant_without_the_method_residual_is_refused_before_the_run(mesh_path, name, said):
    with pytest.raises(UserError, match=rf"{said}.*\(guidance, latents, condition, batch\)"):
        guidance(mesh_path, variant_type=f"test-{name}-variant")


def test_a_variant_with_the_old_name_of_the_method_is_told_and_works(caplog):
    class Named(Variant):
        def error(self, guidance, latents, condition, batch):
            return 0.25 * latents, torch.ones(len(latents))

    assert "Named.error is called residual now" in caplog.text
    residual, _ = Named({}).residual(None, latents(), None, {})
    assert torch.equal(residual, 0.25 * latents())


def test_timesteps_fall_with_the_same_schedule_for_the_smallest_and_the_largest():
    falling = [0, 0.98, 0.02, 50]
    guide, seen = mixture_guidance(min_step_percent=falling, max_step_percent=falling), []
    for at in range(60):
        guide.update_step(0, at)
        t, abar = guide.draw_timesteps(latents())
        assert (t == t[0]).all() and torch.equal(abar, guide.alphas_cumprod[t])
        seen.append(int(t[0]))
    assert seen == sorted(seen, reverse=True) and (seen[0], seen[-1]) == (980, 20)


@pytest.mark.parametrize(
    ("options", "level", "said"),
    [
        (
            {"reuse_steps": 1, "timestep_steps": 0},
            "INFO",
            "reuse_steps is no option any more: each",
        ),
        ({"reuse_steps": 4}, "WARNING", "reuse_steps is no option any more: each step evaluates"),
        ({"timestep_schedule": "linear"}, "WARNING", "give both the same schedule"),
        ({"variant_type": "cfd-variant", "variant": {"refresh": 3}}, "WARNING", "variant.refresh"),
    ],
)
def test_options_of_earlier_versions_are_left_out_with_a_line(
    mesh_path, caplog, options, level, said
):
    caplog.set_level("INFO")
    kept = {"mesh": mesh_path} | {k: v for k, v in options.items() if k == "variant_type"}
    values = OmegaConf.create({"mesh": mesh_path, **options})
    check_part("system.guidance", "exact-score-guidance", values)
    assert {key: value for key, value in values.items() if value != {}} == kept
    lines = [line for line in caplog.records if "no option any more" in line.message]
    assert {line.levelname for line in lines} == {level}
    assert any(said in line.message for line in lines)
    ExactScoreGuidance.preflight({"mesh": mesh_path, **options})
