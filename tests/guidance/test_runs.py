"""Whole runs with guidances of other packages and with tiny diffusion models."""

from pathlib import Path

import pytest
import torch
import yaml

import tests.guidance.test_external  # noqa: F401  registers test-learning-guidance
from tests.helpers import tiny_models
from threestudio_gaussiandreamer import register_parts
from threestudio_gaussiandreamer.guidance.mock import prompt_color
from threestudio_gaussiandreamer.host import BaseObject, register
from threestudio_gaussiandreamer.launch import config_check, experiment
from threestudio_gaussiandreamer.launch.config import load_config
from threestudio_gaussiandreamer.launch.options import find_config

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
    return experiment.main([*arguments, *options])


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
    """Assert that five steps, and three and two, end with the same checkpoint bit for bit."""
    assert run(path, folder / "whole", *options, "trainer.max_steps=5") == 0
    assert run(path, folder / "parts", *options, "trainer.val_check_interval=1") == 0
    last = folder / "parts" / "demo" / "t" / "ckpts" / "last.ckpt"
    assert run(path, folder / "parts", *options, "trainer.max_steps=5", f"resume={last}") == 0
    contents = (checkpoint(folder / name) for name in ("whole", "parts"))
    whole, parts = (flat({key: content[key] for key in PARTS}) for content in contents)
    assert whole.keys() == parts.keys()
    assert not [name for name in whole if not torch.equal(whole[name], parts[name])]
    return whole


NOISES = [
    *("mode=direction-bins", "space=latent", "latent_size=8", "bank_views=12"),
    *("guidance_scale=7.5", "variant_type=vsd-variant"),
]
"""An exact score in which the noise doesn't cancel, with VSD."""


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["own parameters", "moments", "lora"])
def test_a_guidance_that_learns_resumes_as_if_it_had_never_stopped(tmp_path, monkeypatch, kind):
    monkeypatch.chdir(tmp_path)
    system, options, expected = {}, [], {"learner.lora.weight"}
    if kind == "own parameters":
        weights = {"lambda_vsd": 1.0, "lambda_lora": 1.0}
        system = {"guidance_type": "test-learning-guidance", "guidance": {}, "loss": weights}
    elif kind == "moments":
        options, expected = [f"system.guidance.{x}" for x in NOISES], {"mean", "square", "weight"}
    else:
        pytest.importorskip("diffusers")
        system = diffusion(tiny_models.stable_diffusion(tmp_path / "model"))
        options = ["system.guidance.variant_type=vsd-variant"]
    found = assert_resumes(config(tmp_path / "run.yaml", **system), tmp_path, *options)
    learnt = {name.removeprefix("/guidance/") for name in found if name.startswith("/guidance")}
    if kind == "lora":
        assert {"up.0", "exp_avg_sq.up.0", "camera_in"} <= learnt
    else:
        assert learnt == expected
    assert all(value.isfinite().all() for value in found.values())


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


def test_the_mock_guidance_takes_the_place_of_stable_diffusion():
    overrides = ["system.guidance_type=mock-guidance", "system.prompt_processor.prompt=a fox"]
    cfg = load_config(find_config("gaussiandreamer.yaml"), cli_args=overrides)
    config_check.check_config(cfg)
    assert cfg.system.guidance.guidance_scale > 1
    assert "view_dependent_prompting" not in cfg.system.guidance
    assert prompt_color("a fox") != prompt_color("a ball")
