"""Shap-E with tiny weights in the published files: files, sampling, the mesh and its pose, Cap3D's
checkpoint.
"""

import numpy as np
import pytest
import torch

from tests.helpers import tiny_3d_models as tiny
from tests.helpers.prior_contract import PriorContract, assert_valid
from tests.priors.shap_e_cases import CPU, make, seeded
from threestudio_gaussiandreamer.core.errors import UserError
from threestudio_gaussiandreamer.host import find
from threestudio_gaussiandreamer.models.clip import (
    load_text_encoder,
    load_tokenizer,
    text_condition,
)
from threestudio_gaussiandreamer.priors import shap_e as module
from threestudio_gaussiandreamer.priors.karras import guided_denoiser, karras_sigmas, sample_heun
from threestudio_gaussiandreamer.priors.shap_e import ShapEPrior, prior_network, read_schedule


class TestContract(PriorContract):
    @pytest.fixture
    def make_prior(self, folder):
        return lambda **options: make(folder, **options)


def test_registered(folder):
    assert find("shap-e-prior") is ShapEPrior


# -------------------------------------------------------------------------------------------------
# the mesh in the world


def world(values):
    """Convert Shap-E's (x, y, z) to the prior's world: -y is the front."""
    return np.array([-values[1], values[0], values[2]])


def test_the_front_is_plus_x_and_the_scale_is_the_papers(folder):
    cloud = make(folder, grid_size=64)("a fox")
    assert_valid(cloud)
    shrunk = 1.6 * 63 / 65  # the border that closes the surface: see the module
    low, high = cloud.points.min(axis=0), cloud.points.max(axis=0)
    cell = 1.6 * 2 / 64
    np.testing.assert_allclose((low + high) / 2, shrunk * world(tiny.SHAPE_CENTRE), atol=cell)
    np.testing.assert_allclose(
        (high - low) / 2, shrunk * np.abs(world(tiny.SHAPE_HALF_SIDES)), atol=cell
    )
    assert (low + high)[0] > 0  # the shape lies on the -y side of Shap-E's space


def test_all_vertices_lie_on_the_surface_and_all_are_used(folder):
    cloud = make(folder, grid_size=64)("a fox")
    centre, half = (1.6 * 63 / 65 * world(v) for v in (tiny.SHAPE_CENTRE, tiny.SHAPE_HALF_SIDES))
    distance = (np.abs(cloud.points - centre) / np.abs(half)).sum(axis=1)
    assert np.abs(distance - 1).mean() < 0.01
    np.testing.assert_allclose(
        distance, 1, atol=0.08
    )  # half a cell, 1/64, in units of the narrowest half side, 0.2
    assert set(cloud.faces.ravel()) == set(range(len(cloud.points)))


def test_colors_are_display_values_and_can_be_linear(folder):
    display, linear = make(folder)("a fox"), make(folder, colors="linear")("a fox")
    # the renderer asks for colours at the shrunk surface, so here the border plays no part
    z = (display.points[:, 2] / 1.6 - tiny.SHAPE_CENTRE[2]) / tiny.SHAPE_HALF_SIDES[
        2
    ]  # in [-1, 1] up the shape
    expected = np.stack([np.full_like(z, 2.0), z, np.zeros_like(z)], axis=1)
    np.testing.assert_allclose(
        display.colors, 1 / (1 + np.exp(-expected)), atol=0.005
    )  # SiLU near z = 0
    np.testing.assert_allclose(
        linear.colors,
        np.where(display.colors < 0.04045, 0, ((display.colors + 0.055) / 1.055) ** 2.4),
        atol=1e-5,
    )


def test_queries_in_chunks_change_nothing(folder):
    for a, b in zip(
        make(folder, query_batch_size=1000)("a fox"), make(folder)("a fox"), strict=True
    ):
        if a is not None:
            np.testing.assert_allclose(
                a, b, atol=1e-6
            )  # matrix products of other sizes round differently


def test_normalize_and_front(folder):
    cloud = make(folder, normalize=True, scale=0.7, front="+x")("a fox")
    np.testing.assert_allclose(
        np.abs([cloud.points.min(axis=0), cloud.points.max(axis=0)]).max(), 0.7, rtol=1e-6
    )
    plain = make(folder)("a fox")
    sides, turned = np.ptp(plain.points, axis=0), np.ptp(cloud.points, axis=0)
    np.testing.assert_allclose(turned / turned.max(), sides[[1, 0, 2]] / sides.max(), rtol=1e-5)


def test_no_surface_is_a_message(copy):
    from diffusers.pipelines.shap_e.renderer import ShapERenderer

    renderer = ShapERenderer.from_pretrained(copy / "shap_e_renderer")
    with torch.no_grad():
        renderer.mlp.mlp[2].bias[0] = -5.0
    renderer.save_pretrained(copy / "shap_e_renderer")
    with pytest.raises(UserError, match="no surface"):
        make(copy)("a fox")


def test_latents_that_are_not_finite_are_a_message(folder):
    with pytest.raises(UserError, match="half_precision"):
        module.decoded(
            None,
            torch.full((1, 16, 8), torch.nan),
            grid_size=8,
            query_batch_size=8,
            colors="display",
        )


# --------------------------------------------------------------------------------------------------
# sampling


def test_text_condition_equals_the_pipelines(folder):
    """Without padding, and with our loading; diffusers pads to 77 tokens."""
    from diffusers import ShapEPipeline

    pipeline = ShapEPipeline.from_pretrained(folder)
    ours = make(folder)._condition(folder, "a red fox", CPU)
    theirs = pipeline._encode_prompt("a red fox", CPU, 1, True)
    torch.testing.assert_close(
        torch.cat([torch.zeros_like(ours), ours]), theirs, atol=1e-5, rtol=1e-5
    )
    assert ours.square().mean().item() == pytest.approx(1, abs=1e-5)


def test_a_prompt_beyond_77_tokens_is_cut(folder):
    encoder = load_text_encoder(folder, "text_encoder")
    tokenizer = load_tokenizer(folder, "tokenizer")
    torch.testing.assert_close(
        text_condition(tokenizer, encoder, "x" * 400), text_condition(tokenizer, encoder, "x" * 500)
    )


def test_our_sampler_agrees_with_the_pipelines(copy):
    """With noise levels given to its scheduler and a network that ignores time (its timesteps are
    fractional, ours are not) and stays within [-1, 1] (it clamps after guidance, the published code
    before), both are one algorithm.
    """
    from diffusers import PriorTransformer, ShapEPipeline

    prior = PriorTransformer.from_pretrained(copy / "prior")
    with torch.no_grad():
        prior.time_embedding.linear_1.weight.zero_()
        prior.proj_to_clip_embeddings.weight.mul_(0.02)
    prior.save_pretrained(copy / "prior")
    ours = make(copy, num_inference_steps=6, guidance_scale=3.0)._sample(
        copy, "a red fox", CPU, seeded()
    )
    pipeline = ShapEPipeline.from_pretrained(copy)
    pipeline.scheduler.register_to_config(sigma_min=1e-3, sigma_max=160.0)
    noise = torch.randn(1, 16, 8, generator=seeded()).flatten(1)
    theirs = pipeline(
        "a red fox", num_inference_steps=6, guidance_scale=3.0, latents=noise, output_type="latent"
    ).images
    assert pipeline.scheduler.sigmas[0].item() == pytest.approx(160) and pipeline.scheduler.sigmas[
        -2
    ].item() == pytest.approx(1e-3)
    assert ours.abs().max() < 1
    torch.testing.assert_close(
        ours, theirs, atol=2e-5, rtol=0
    )  # 160 in float32 has a spacing of 1.5e-5


def test_what_the_scheduler_would_do_by_itself(folder):
    """The levels stated in the module's docstring, which are the reason for our own sampler."""
    from diffusers import HeunDiscreteScheduler

    scheduler = HeunDiscreteScheduler.from_pretrained(folder, subfolder="scheduler")
    scheduler.set_timesteps(64)
    assert scheduler.sigmas[0].item() == pytest.approx(403.4, abs=0.1) and scheduler.sigmas[
        -2
    ].item() == pytest.approx(0.1085, abs=1e-3)


def test_schedule_is_the_models(folder):
    alphas_cumprod, prediction = read_schedule(folder)
    assert prediction == "sample" and len(alphas_cumprod) == 1024
    np.testing.assert_allclose(
        alphas_cumprod[[0, 511, 1023]], np.exp(-12 * np.array([1, 512, 1024]) / 1024), rtol=1e-3
    )  # float32 betas


def test_prompt_seed_guidance_and_steps_matter(folder):
    base = make(folder)._sample(folder, "a fox", CPU, seeded())
    torch.testing.assert_close(
        make(folder)._sample(folder, "a fox", CPU, seeded()), base, rtol=0, atol=0
    )
    others = [
        make(folder)._sample(folder, "a bear", CPU, seeded()),
        make(folder)._sample(folder, "a fox", CPU, seeded(1)),
        make(folder, guidance_scale=1.0)._sample(folder, "a fox", CPU, seeded()),
        make(folder, num_inference_steps=3)._sample(folder, "a fox", CPU, seeded()),
    ]
    assert all((other - base).abs().max() > 1e-4 for other in others)


def test_own_prompt_option(folder, monkeypatch):
    asked = []
    monkeypatch.setattr(
        ShapEPrior,
        "_sample",
        lambda self, folder, prompt, *rest: asked.append(prompt) or torch.zeros(1, 16, 8),
    )
    make(folder)("a fox, highly detailed")
    make(folder, prompt="a fox")("a fox, highly detailed")
    assert asked == ["a fox, highly detailed", "a fox"]


def test_no_prompt_is_the_second_half_of_the_condition():
    seen = []

    def prior(z, timesteps, conditions):
        seen.append(conditions)
        return type("Output", (), {"predicted_image_embedding": torch.cat([z, z], dim=-1)})

    condition = torch.ones(1, 5)
    denoise = guided_denoiser(
        prior_network(prior, condition, 15.0, half=False),
        np.linspace(0.99, 1e-4, 50),
        scale=15.0,
        prediction="sample",
    )
    assert denoise(torch.zeros(1, 4, 3), 1.0).shape == (1, 4, 3)
    assert seen[0].tolist() == [[1.0] * 5, [0.0] * 5]


def test_networks_are_freed(folder):
    """Stable Diffusion, which is loaded next, needs the memory."""
    import gc

    from diffusers import ModelMixin

    make(folder)("a fox")
    gc.collect()
    assert not [thing for thing in gc.get_objects() if isinstance(thing, ModelMixin)]


# --------------------------------------------------------------------------------------------------
# options


@pytest.mark.parametrize(
    "option",
    [
        {"guidance_scale": 0.0},
        {"num_inference_steps": 0},
        {"sigma_min": 200.0},
        {"grid_size": 1},
        {"query_batch_size": 0},
        {"colors": "srgb"},
        {"front": "up"},
        {"scale": 0.0},
    ],
)
def test_options_out_of_range(folder, option):
    with pytest.raises(UserError, match=next(iter(option)).split("_")[0]):
        make(folder, **option)


def test_an_unknown_device_is_named(folder):
    with pytest.raises(UserError, match="device: 'gpu'"):
        make(folder, device="gpu").preflight()


def test_defaults_are_the_papers():
    cfg = ShapEPrior({}).cfg
    assert (
        cfg.guidance_scale,
        cfg.num_inference_steps,
        cfg.sigma_min,
        cfg.sigma_max,
        cfg.grid_size,
        cfg.scale,
    ) == (
        15,
        64,
        1e-3,
        160,
        128,
        1.6,
    )
    assert len(karras_sigmas(64, 1e-3, 160)) == 65


def test_sampling_is_without_gradients(folder):
    assert not make(folder)._sample(folder, "a fox", CPU, seeded()).requires_grad
    assert (
        sample_heun(lambda x, sigma: x, torch.zeros(1), [1.0, 0.0], generator=seeded()).item() == 0
    )
