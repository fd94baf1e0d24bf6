"""UNets that take the guidance scale as an input: one evaluation per view."""

from types import SimpleNamespace

import pytest
import torch

from tests.helpers import tiny_guidance as tiny
from tests.helpers import tiny_models
from threestudio_gaussiandreamer.guidance import text_to_image
from threestudio_gaussiandreamer.prompts import prompt_processors  # noqa: F401

diffusers = pytest.importorskip("diffusers")

WIDTH = 32
SIZES = tiny_models.TINY._replace(unet=tiny_models.TINY.unet | {"time_cond_proj_dim": WIDTH})


@pytest.fixture(scope="module")
def models(tmp_path_factory):
    """Write a tiny latent consistency model, with the scheduler that these have."""
    folder = tiny_models.stable_diffusion(tmp_path_factory.mktemp("lcm"), sizes=SIZES)
    trained = {"beta_start": 0.00085, "beta_end": 0.012, "beta_schedule": "scaled_linear"}
    diffusers.LCMScheduler(**trained).save_pretrained(folder / "scheduler")
    return {"epsilon": folder}


def scale_input(scale, width, count):
    part = SimpleNamespace(scale_width=width, device=torch.device("cpu"), dtype=torch.float32)
    return text_to_image.TextToImageDistillation.scale_input(part, scale, count)


@pytest.fixture(scope="module")
def prompts(models):
    return tiny.make_prompts(models)


def recorded(models, prompt_utils, **options):
    """Return the gradient of four views, and the UNet's calls for it."""
    guide = tiny.guidance(models, **options)
    guide.unet = recorder = tiny.Recorder(guide.unet)
    grad, out = tiny.gradient(guide, prompt_utils, tiny.renders())
    assert out["evaluations"] == sum(len(args[0]) for args, _ in recorder.calls)
    return grad, recorder.calls


def test_one_evaluation_per_view_with_the_published_embedding(models, prompts, caplog):
    _, [(args, inputs)] = recorded(models, prompts[False], guidance_scale=4.0)
    assert "guidance_scale" not in caplog.text
    tiny.guidance(models, guidance_scale=101.0)
    assert "guidance_scale=101: expected 1 to 20" in caplog.text
    own = scale_input(4.0, WIDTH, 4)
    assert len(args[0]) == 4
    torch.testing.assert_close(inputs["timestep_cond"], own["timestep_cond"])
    # the noise is the network's own prediction
    guide = tiny.guidance(models, guidance_scale=4.0)
    z, t = torch.randn(4, 4, 8, 8, generator=torch.Generator().manual_seed(0)), tiny.TIMESTEPS
    condition = guide.condition(prompts[False], **tiny.BATCH)
    tokens = condition.embeddings[:4]
    expected = guide.unet(z, t, encoder_hidden_states=tokens, **own).sample
    torch.testing.assert_close(guide.predict_noise(z, t, condition), expected)
    # a negative scale, as in the inversion of sdi-variant, is extrapolated: no network knows it
    guide.unet = recorder = tiny.Recorder(guide.unet)
    guide.guided_noise(z, t, condition, -6.5)
    [(args, inputs)] = recorder.calls
    without = scale_input(1.0, WIDTH, 8)["timestep_cond"]
    assert len(args[0]) == 8
    torch.testing.assert_close(inputs["timestep_cond"], without)
    make = diffusers.LatentConsistencyModelPipeline.get_guidance_scale_embedding
    for scale, width in ((1.0, WIDTH), (4.0, 256), (8.5, WIDTH)):
        own = scale_input(scale, width, 3)["timestep_cond"]
        published = make(None, torch.full((3,), scale - 1), width)
        # angles are up to 7500, so float32 rounds them to 5e-4
        torch.testing.assert_close(own, published, atol=1e-3, rtol=0)


@pytest.mark.parametrize(
    ("perp_neg", "options", "rows"),
    [
        (True, {}, 16),
        (False, {"recon_std_rescale": 0.5}, 8),
        (False, {"variant_type": "csd-variant"}, 8),
    ],
)
def test_other_predictions_are_without_guidance(models, prompts, perp_neg, options, rows):
    _, calls = recorded(models, prompts[perp_neg], guidance_scale=4.0, **options)
    assert sum(len(args[0]) for args, _ in calls) == rows
    for args, inputs in calls:
        without = scale_input(1.0, WIDTH, len(args[0]))["timestep_cond"]
        torch.testing.assert_close(inputs["timestep_cond"], without)


def test_view_contrast_is_that_of_predictions_with_guidance(models, monkeypatch):
    """Continuous at 0, and two evaluations per view in place of three."""
    options = {"guidance_scale": 4.0}
    monkeypatch.setattr(text_to_image, "CONTRAST_FROM", 0.0)
    prompt_utils = tiny.left_and_right(models)
    z = torch.randn(4, 4, 8, 8, generator=torch.Generator().manual_seed(0))

    def predicted(contrast, turned=0):
        guide = tiny.guidance(models, view_contrast=contrast, **options)
        batch = tiny.BATCH | {"azimuth": tiny.BATCH["azimuth"] + turned}
        condition = guide.condition(prompt_utils, **batch)
        guide.evaluations = 0
        return guide.predict_noise(z, tiny.TIMESTEPS, condition), guide.evaluations

    (plain, few), (other, _), (cond, more) = predicted(0.0), predicted(0.0, 180), predicted(0.5)
    torch.testing.assert_close(cond, plain + 0.5 * (plain - other))
    assert (few, more) == (4, 8)
