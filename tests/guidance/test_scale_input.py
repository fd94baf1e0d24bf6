"""UNets that take the guidance scale as an input: one evaluation per view, the published embedding,
and all that needs the unconditional prediction.
"""

from types import SimpleNamespace

import pytest
import torch

from tests.helpers import tiny_guidance as tiny
from tests.helpers import tiny_large_models, tiny_models
from threestudio_gaussiandreamer.guidance import (
    stable_diffusion_xl,  # noqa: F401
    text_to_image,
)
from threestudio_gaussiandreamer.guidance.text_to_image import TextToImageDistillation
from threestudio_gaussiandreamer.host import find
from threestudio_gaussiandreamer.prompts import pooled_prompt_processors  # noqa: F401

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
    return TextToImageDistillation.scale_input(part, scale, count)


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


@pytest.mark.parametrize("scale", [1.0, 4.0, 8.5])
@pytest.mark.parametrize("width", [WIDTH, 256])
def test_the_embedding_is_that_of_the_published_pipeline(scale, width):
    make = diffusers.LatentConsistencyModelPipeline.get_guidance_scale_embedding
    own = scale_input(scale, width, 3)["timestep_cond"]
    published = make(None, torch.full((3,), scale - 1), width)
    # angles are up to 7500, so float32 rounds them to 5e-4
    torch.testing.assert_close(own, published, atol=1e-3, rtol=0)


def test_other_networks_get_no_scale():
    assert scale_input(4.0, None, 3) == {}


def test_one_evaluation_per_view_with_the_scale(models, prompts):
    grad, [(args, inputs)] = recorded(models, prompts[False], guidance_scale=4.0)
    assert len(args[0]) == 4
    torch.testing.assert_close(inputs["timestep_cond"], scale_input(4.0, WIDTH, 4)["timestep_cond"])
    other, _ = recorded(models, prompts[False], guidance_scale=8.5)
    assert tiny.relative(other, grad) > 1e-3


def test_the_error_is_the_networks_own_prediction(models, prompts):
    guide = tiny.guidance(models, guidance_scale=4.0)
    z, t = torch.randn(4, 4, 8, 8, generator=torch.Generator().manual_seed(0)), tiny.TIMESTEPS
    condition = guide.condition(prompts[False], **tiny.BATCH)
    tokens = condition.embeddings[:4]
    expected = guide.unet(z, t, encoder_hidden_states=tokens, **scale_input(4.0, WIDTH, 4)).sample
    torch.testing.assert_close(guide.predict_noise(z, t, condition), expected)


@pytest.mark.parametrize(
    ("perp_neg", "options", "rows"),
    [
        (True, {}, 16),
        (False, {"recon_std_rescale": 0.5}, 8),
        (False, {"variant_type": "csd-variant"}, 8),
    ],
)
def test_what_needs_other_predictions_gets_them_without_guidance(
    models, prompts, perp_neg, options, rows
):
    _, calls = recorded(models, prompts[perp_neg], guidance_scale=4.0, **options)
    assert sum(len(args[0]) for args, _ in calls) == rows
    for args, inputs in calls:
        without = scale_input(1.0, WIDTH, len(args[0]))["timestep_cond"]
        torch.testing.assert_close(inputs["timestep_cond"], without)


def test_a_negative_scale_is_extrapolated_and_not_an_input(models, prompts):
    """The inversion of sdi-variant has one; no network was trained for it."""
    guide = tiny.guidance(models, guidance_scale=4.0)
    guide.unet = recorder = tiny.Recorder(guide.unet)
    z = torch.randn(4, 4, 8, 8, generator=torch.Generator().manual_seed(0))
    guide.guided_noise(z, tiny.TIMESTEPS, guide.condition(prompts[False], **tiny.BATCH), -6.5)
    [(args, inputs)] = recorder.calls
    without = scale_input(1.0, WIDTH, 8)["timestep_cond"]
    assert len(args[0]) == 8
    torch.testing.assert_close(inputs["timestep_cond"], without)


def test_a_scale_that_no_model_knows_is_warned_of(models, caplog):
    tiny.guidance(models, guidance_scale=101.0)
    assert "guidance_scale=101" in caplog.text and "expected 1 to 20" in caplog.text
    caplog.clear()
    tiny.guidance(models, guidance_scale=8.5)
    assert "guidance_scale" not in caplog.text


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


@pytest.mark.parametrize("variant", ["nfsd", "vsd", "ism", "sdi"])
def test_variants_train_with_it(models, prompts, variant):
    guide = tiny.guidance(models, guidance_scale=4.0, variant_type=f"{variant}-variant")
    views = {"c2w": torch.eye(4).expand(4, 4, 4), "fovy": torch.full((4,), 0.8)}
    out = guide(tiny.renders(), prompts[False], **tiny.BATCH, **views)
    assert out["loss_sds"].isfinite() and out["grad_norm"] > 0


def test_stable_diffusion_xl_takes_it_too(tmp_path):
    folder = tiny_large_models.stable_diffusion_xl(tmp_path)
    unet = diffusers.UNet2DConditionModel.from_pretrained(folder / "unet")
    options = {**unet.config, "time_cond_proj_dim": WIDTH}
    diffusers.UNet2DConditionModel.from_config(options).save_pretrained(folder / "unet")
    name = {"pretrained_model_name_or_path": str(folder)}
    guide = find("gaussiandreamer-stable-diffusion-xl-guidance")(name | {"guidance_scale": 4.0})
    processor = find("gaussiandreamer-stable-diffusion-xl-prompt-processor")
    prompt_utils = processor({**name, "prompt": "a fox", "use_cache": False})()
    guide.unet = recorder = tiny.Recorder(guide.unet)
    tiny.gradient(guide, prompt_utils, tiny.renders())
    [(args, inputs)] = recorder.calls
    assert len(args[0]) == 4 and inputs["timestep_cond"].shape == (4, WIDTH)
