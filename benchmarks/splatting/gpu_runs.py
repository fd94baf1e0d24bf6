"""The sections of ``gpu_check`` that run whole commands: pruning, and steps of training."""

import argparse
import os
import statistics
import tempfile
import time
from pathlib import Path
from typing import Any

import torch

from benchmarks.splatting.gpu_kernels import synchronize
from benchmarks.splatting.gpu_processes import guarded, in_process

STEPS_OF_A_RUN = 1200


# ---- pruning -------------------------------------------------------------------------------------


def prune(args: argparse.Namespace) -> dict[str, Any]:
    return in_process("prune_twice", args)


def prune_twice(args: argparse.Namespace) -> dict[str, Any]:
    from benchmarks.quality.bench_prune import torus_and_sphere
    from threestudio_gaussiandreamer.formats.gaussian_files import StoredCloud
    from threestudio_gaussiandreamer.gaussians.views import psnr_to_original, render_all
    from threestudio_gaussiandreamer.host import get_device
    from threestudio_gaussiandreamer.prune import PruneOptions, prune_to_budget
    from threestudio_gaussiandreamer.prune.pipeline import views_of

    stored = StoredCloud(torus_and_sphere(800 if args.small else 100_000).arrays())
    options = PruneOptions(
        count=len(stored.gaussians.means) // 4,
        size=48 if args.small else 256,
        steps=4 if args.small else 60,
    )
    first, second = (prune_to_budget(stored, options, ".ply", "") for _ in range(2))
    before, after = (cloud.gaussians.tensors(get_device()) for cloud in (stored, first.after))
    views = views_of(stored, options)[-1]
    same = all(
        a.tobytes() == b.tobytes()
        for a, b in zip(first.after.gaussians, second.after.gaussians, strict=True)
    )
    return {
        "gaussians": [len(before.means), len(after.means)],
        "psnr": round(psnr_to_original(after, views, render_all(before, views)), 2),
        "seconds": [round(done.seconds, 2) for done in (first, second)],
    } | ({} if same else {"failed": "pruning the same cloud again gave other bits"})


# ---- a training step -----------------------------------------------------------------------------


def train(args: argparse.Namespace) -> dict[str, Any]:
    """Return seconds per step and memory of the paper's configuration, and of its low-memory
    variant.
    """
    with tempfile.TemporaryDirectory() as folder:
        environment = {"GPU_CHECK_MODEL": str(Path(folder) / "model"), "HF_HUB_OFFLINE": "1"}
        in_process("make_model", args, environment)
        overlays = {"default": "", "lowmem": "gaussiandreamer-lowmem.yaml"}
        return {
            name: guarded(
                lambda _, overlay=overlay: in_process(
                    "train_steps", args, environment | {"GPU_CHECK_OVERLAY": overlay}
                ),
                args,
            )
            for name, overlay in overlays.items()
        }


def make_model(args: argparse.Namespace) -> dict[str, Any]:
    from tests.helpers import tiny_models

    sizes = tiny_models.TINY if args.small else tiny_models.STABLE_DIFFUSION_2_1
    return {
        "folder": str(
            tiny_models.stable_diffusion(Path(os.environ["GPU_CHECK_MODEL"]), sizes=sizes)
        )
    }


def train_steps(args: argparse.Namespace) -> dict[str, Any]:
    """Run the launcher for a few steps; the first ones, which warm up, aren't counted."""
    from threestudio_gaussiandreamer.launch import experiment
    from threestudio_gaussiandreamer.training import system

    seconds, original = [], system.GaussianDreamerSystem.training_step

    def step(self: Any, *arguments: Any) -> Any:
        synchronize(args)
        started = time.perf_counter()
        result = original(self, *arguments)
        synchronize(args)
        seconds.append(time.perf_counter() - started)
        return result

    system.GaussianDreamerSystem.training_step = step
    with tempfile.TemporaryDirectory() as folder:
        code = experiment.main(training_arguments(args, folder))
    if code:
        raise RuntimeError(f"the launcher ended with {code}")
    per_step = statistics.median(seconds[len(seconds) // 2 :])
    memory = (
        {"peak_gb": round(torch.cuda.max_memory_allocated() / 2**30, 2)}
        if args.device == "cuda"
        else {}
    )
    return {
        "seconds_per_step": round(per_step, 4),
        "extrapolated_minutes_for_1200_steps": round(per_step * STEPS_OF_A_RUN / 60, 2),
    } | memory


def training_arguments(args: argparse.Namespace, folder: str) -> list[str]:
    """Return the paper's configuration with a mesh instead of Shap-E, which plays no part in a
    step.
    """
    overlays = [
        part
        for name in ("gaussiandreamer.yaml", os.environ["GPU_CHECK_OVERLAY"])
        if name
        for part in ("--config", name)
    ]
    steps = 4 if args.small else 16
    sizes = (
        {"data.width": 64, "data.height": 64, "system.geometry.grow.num_candidates": 2000}
        if args.small
        else {}
    )
    options = sizes | {
        "exp_root_dir": folder, "system.prompt_processor.prompt": "a fox",
        "system.prompt_processor.pretrained_model_name_or_path": os.environ["GPU_CHECK_MODEL"],
        "system.guidance.pretrained_model_name_or_path": os.environ["GPU_CHECK_MODEL"],
        "system.geometry.prior_type": "mesh-prior", "system.geometry.prior.path": "toy.glb",
        "system.geometry.prior.num_points": 500 if args.small else 80_000,
        "system.geometry.grow.max_points": 100 if args.small else 20_000,
        "trainer.max_steps": steps, "trainer.val_check_interval": 100_000,
        "trainer.enable_progress_bar": "false", "data.n_test_views": 1, "data.eval_width": 64,
        "data.eval_height": 64, "system.exporter.save_video": "false",
    }  # fmt: skip
    device = [] if args.device == "cuda" else ["--gpu", "cpu"]
    return [*overlays, "--train", *device, *(f"{key}={value}" for key, value in options.items())]
