"""Whole runs of three steps with any guidance, and resumed runs."""

from pathlib import Path

import torch
import yaml

from threestudio_gaussiandreamer.launch.experiment import main

PARTS = ("state_dict", "guidance", "optimizer_states")
"""Sections of a checkpoint that must not depend on interruptions."""


def config(path, **system):
    """Return the configuration of three steps from random points; tests vary ``system``."""
    cfg = yaml.safe_load((Path(__file__).parents[2] / "configs" / "demo.yaml").read_text())
    sizes = dict.fromkeys(("width", "height", "eval_width", "eval_height"), 16)
    sizes |= {"n_test_views": 2, "train_views": 0}
    geometry = {
        **cfg["system"]["geometry"],
        "prior_type": "random-prior",
        "prior": {"num_points": 60},
        "grow": {"num_candidates": 100},
    }
    evaluation = {"views": 2, "size": 16, "every": 0}
    cfg |= {
        "data": {**cfg["data"], **sizes},
        "system": {**cfg["system"], "geometry": geometry, "evaluation": evaluation, **system},
    }
    cfg |= {"tag": "t", "use_timestamp": False}
    cfg["trainer"] |= {
        "max_steps": 3,
        "val_check_interval": 3,
        "log_every_n_steps": 1,
        "enable_progress_bar": False,
    }
    path.write_text(yaml.safe_dump(cfg))
    return path


def diffusion(model, family="stable-diffusion"):
    """Return the options that a user gives for the real weights."""
    return {
        "prompt_processor_type": f"{family}-prompt-processor",
        "prompt_processor": {
            "pretrained_model_name_or_path": "${system.guidance.pretrained_model_name_or_path}",
            "prompt": "a fox",
            "negative_prompt": "ugly",
            "use_perp_neg": True,
        },
        "guidance_type": f"{family}-guidance",
        "guidance": {
            "pretrained_model_name_or_path": str(model),
            "guidance_scale": 20.0,
            "max_step_percent": [2, 0.98, 0.55, 3],
            "grad_clip": [0, 1.5, 2.0, 1000],
        },
    }


def run(path, folder, *options):
    return main(
        ["--config", str(path), "--train", "--gpu", "cpu", f"exp_root_dir={folder}", *options]
    )


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
    whole, parts = (
        {key: checkpoint(folder / name)[key] for key in PARTS} for name in ("whole", "parts")
    )
    whole, parts = flat(whole), flat(parts)
    assert whole.keys() == parts.keys() and not [
        name for name in whole if not torch.equal(whole[name], parts[name])
    ]
    return whole
