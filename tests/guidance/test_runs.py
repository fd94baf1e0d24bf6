"""Whole runs with guidances of other packages and with tiny diffusion models."""

from pathlib import Path

import pytest
import torch
import yaml

import tests.guidance.test_external  # noqa: F401  registers test-learning-guidance
from tests.helpers import tiny_models
from threestudio_gaussiandreamer import register_parts
from threestudio_gaussiandreamer.host import BaseObject, register
from threestudio_gaussiandreamer.launch.experiment import main
from threestudio_gaussiandreamer.priors.random import RandomPrior

register_parts()

BATCH_KEYS = {"c2w", "fovy", "height", "width", "elevation", "azimuth", "camera_distances"}
BATCH_KEYS |= {"camera_positions", "mvp_mtx", "proj_mtx"}


@register("test-multiview-guidance")
class MultiviewDouble(BaseObject):
    """The signature of threestudio's MVDream extension; it returns two losses."""

    seen: list = []

    def __call__(
        self, rgb, prompt_utils, elevation, azimuth, camera_distances,
        c2w, rgb_as_latents=False, fovy=None, comp_rgb_bg=None, **kwargs,
    ):  # fmt: skip
        known = {"elevation", "azimuth", "camera_distances", "c2w", "fovy", *kwargs}
        self.seen.append((prompt_utils, known))
        shapes = {x.shape for x in (elevation, azimuth, camera_distances, fovy)}
        assert shapes == {(len(rgb),)} and c2w.shape == (len(rgb), 4, 4)
        # as threestudio's unified guidance
        looks = {"timesteps": torch.full((len(rgb),), 400), "rgb": rgb.detach(), "eval": {"bs": 1}}
        losses = {"loss_sds": (rgb - 0.2).square().sum(), "loss_recon": rgb.mean()}
        return losses | looks | {"grad_norm": rgb.detach().norm()}


PARTS = ("state_dict", "guidance", "optimizer_states")
"""Sections of a checkpoint that must not depend on interruptions."""


def config(path, **system):
    """Return the configuration of three steps from random points; tests vary ``system``."""
    cfg = yaml.safe_load((Path(__file__).parents[2] / "configs" / "demo.yaml").read_text())
    cfg |= {"tag": "t", "use_timestamp": False}
    sizes = dict.fromkeys(("width", "height", "eval_width", "eval_height"), 16)
    cfg["data"] |= sizes | {"n_test_views": 2, "train_views": 0}
    start = {"prior_type": "random-prior", "prior": {"num_points": 60}}
    cfg["system"]["geometry"] |= start | {"grow": {"num_candidates": 100}}
    cfg["system"] |= {"evaluation": {"views": 2, "size": 16, "every": 0}, **system}
    often = {"max_steps": 3, "val_check_interval": 3, "log_every_n_steps": 1}
    cfg["trainer"] |= often | {"enable_progress_bar": False}
    path.write_text(yaml.safe_dump(cfg))
    return path


def diffusion(model):
    """Return the options that a user gives for the real weights."""
    return {
        "prompt_processor_type": "stable-diffusion-prompt-processor",
        "prompt_processor": {
            "pretrained_model_name_or_path": "${system.guidance.pretrained_model_name_or_path}",
            "prompt": "a fox",
            "negative_prompt": "ugly",
            "use_perp_neg": True,
        },
        "guidance_type": "stable-diffusion-guidance",
        "guidance": {
            "pretrained_model_name_or_path": str(model),
            "guidance_scale": 20.0,
            "max_step_percent": [2, 0.98, 0.55, 3],
            "grad_clip": [0, 1.5, 2.0, 1000],
        },
    }


def run(path, folder, *options):
    arguments = ["--config", str(path), "--train", "--gpu", "cpu", f"exp_root_dir={folder}"]
    return main([*arguments, *options])


def checkpoint(folder):
    return torch.load(folder / "demo" / "t" / "ckpts" / "last.ckpt", weights_only=True)


def flat(content, name=""):
    """Return every tensor of a part of a checkpoint by its path."""
    if isinstance(content, torch.Tensor):
        return {name: content}
    if isinstance(content, (list, tuple)):
        content = dict(enumerate(content))
    found = {}
    for key, value in content.items() if isinstance(content, dict) else ():
        found |= flat(value, f"{name}/{key}")
    return found


def assert_resumes(path, folder, *options):
    """Assert that five steps at once, and three and two with more validation, end with the same
    checkpoint bit for bit.
    """
    assert run(path, folder / "whole", *options, "trainer.max_steps=5") == 0
    assert run(path, folder / "parts", *options, "trainer.val_check_interval=1") == 0
    last = folder / "parts" / "demo" / "t" / "ckpts" / "last.ckpt"
    assert run(path, folder / "parts", *options, "trainer.max_steps=5", f"resume={last}") == 0
    contents = (checkpoint(folder / name) for name in ("whole", "parts"))
    whole, parts = (flat({key: content[key] for key in PARTS}) for content in contents)
    assert whole.keys() == parts.keys()
    assert not [name for name in whole if not torch.equal(whole[name], parts[name])]
    return whole


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


def test_a_guidance_by_name_gets_the_full_batch_and_all_its_losses_count(tmp_path, capsys):
    system = {"guidance_type": "test-multiview-guidance", "guidance": {}}
    system["loss"] = {"lambda_sds": 1.0}
    assert run(config(tmp_path / "run.yaml", **system), tmp_path) == 2
    assert "system.loss.lambda_recon" in capsys.readouterr().err
    system["loss"]["lambda_recon"] = 0.5
    MultiviewDouble.seen.clear()
    assert run(config(tmp_path / "run.yaml", **system), tmp_path) == 0
    prompt_utils, keys = MultiviewDouble.seen[0]
    assert prompt_utils.prompt == "a painted toy"
    assert BATCH_KEYS <= keys


NOISES = {
    "system.guidance.mode": "direction-bins",
    "system.guidance.space": "latent",
    "system.guidance.latent_size": 8,
    "system.guidance.bank_views": 12,
    "system.guidance.guidance_scale": 7.5,
}
"""An exact score in which the noise doesn't cancel."""


def options(variant, **more):
    chosen = NOISES | {"system.guidance.variant_type": variant} | more
    return [f"{key}={value}" for key, value in chosen.items()]


@pytest.mark.slow
@pytest.mark.parametrize("variant", ["vsd-variant", "cfd-variant"])
def test_a_run_with_the_exact_score_resumes_as_if_it_had_never_stopped(tmp_path, variant):
    found = assert_resumes(config(tmp_path / "run.yaml"), tmp_path, *options(variant))
    moments = {name for name in found if name.startswith("/guidance")}
    expected = {"mean", "square", "weight"} if variant == "vsd-variant" else set()
    assert moments == {f"/guidance/{name}" for name in expected}


@pytest.mark.slow
def test_a_lora_resumes_as_if_it_had_never_stopped(tmp_path, monkeypatch):
    pytest.importorskip("diffusers")
    monkeypatch.chdir(tmp_path)
    model = tiny_models.stable_diffusion(tmp_path / "model")
    path = config(tmp_path / "run.yaml", **diffusion(model))
    found = assert_resumes(path, tmp_path, "system.guidance.variant_type=vsd-variant")
    assert any(name.startswith("/guidance/up.") for name in found)
    assert any(name.startswith("/guidance/exp_avg_sq.") for name in found)
    assert all(value.isfinite().all() for value in found.values())


def test_a_variant_that_cannot_work_ends_the_run_before_the_prior(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(RandomPrior, "generate", lambda *args: pytest.fail("ran the prior"))
    blind = {"system.guidance.mode": "view-agnostic"}
    path = config(tmp_path / "run.yaml")
    assert run(path, tmp_path, *options("csd-variant", **blind)) == 2
    assert "csd-variant follows the difference" in capsys.readouterr().err
