"""The sections of ``gpu_check`` that train: milliseconds of a step of the paper's configuration,
with a U-Net and a VAE of Stable Diffusion's size and with networks that do nothing, whole runs of
both demos, and the lines that wait for the GPU."""

import argparse
import contextlib
import json
import os
import tempfile
import time
import traceback
import unittest.mock
import warnings
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

from benchmarks.splatting.gpu_kernels import synchronize
from benchmarks.splatting.gpu_processes import guarded, in_process

ROOT = Path(__file__).resolve().parents[2]
REST_AIM = 0.03
"""What a step should take at most besides U-Net and VAE, over the U-Net's time."""
WINDOWS = {False: (10, 40), True: (1, 3)}
"""The first step that is timed and the one after the last, of a check and of a small one."""
SMALL_PICTURES = {"data.eval_width": 64, "data.eval_height": 64}
PROMPT = {"system.prompt_processor.prompt": "a red fox with a green scarf"}
DEMOS = {"demo.yaml": {}, "toybox.yaml": PROMPT}
"""Their options."""
FEW = {"data.train_views": 4, "system.evaluation.views": 1, "system.evaluation.size": 16}
SHORT = {"system.geometry.prior.num_steps": 2, "system.geometry.grow.num_candidates": 20_000}
SMALL_DEMOS = {"demo.yaml": FEW, "toybox.yaml": SHORT}
"""Further options of a small check."""


def train(args: argparse.Namespace) -> dict[str, Any]:
    """Return milliseconds per step and memory of the paper's configuration, and of its low-memory
    variant.
    """
    with tempfile.TemporaryDirectory() as folder:
        environment = {"GPU_CHECK_MODEL": str(Path(folder) / "model"), "HF_HUB_OFFLINE": "1"}
        in_process("make_model", args, environment)
        overlays = {"default": "", "lowmem": "gaussiandreamer-lowmem.yaml"}
        found = {}
        for name, overlay in overlays.items():
            own = environment | {"GPU_CHECK_OVERLAY": overlay}
            found[name] = guarded(lambda _, own=own: in_process("train_steps", args, own), args)
        return found


STABLE_DIFFUSION_2_1 = {
    "unet": dict(
        sample_size=64, block_out_channels=(320, 640, 1280, 1280), layers_per_block=2,
        down_block_types=("CrossAttnDownBlock2D",) * 3 + ("DownBlock2D",),
        up_block_types=("UpBlock2D",) + ("CrossAttnUpBlock2D",) * 3,
        attention_head_dim=(5, 10, 20, 20),
    ),
    "vae": dict(sample_size=512, block_out_channels=(128, 256, 512, 512), layers_per_block=2),
    "text_width": 1024,
}  # fmt: skip
"""The published UNet and VAE; of its text encoder, which a run frees at once, the width alone."""


def make_model(args: argparse.Namespace) -> dict[str, Any]:
    from tests.helpers import tiny_models

    sizes = tiny_models.TINY if args.small else tiny_models.Sizes(**STABLE_DIFFUSION_2_1)
    folder = Path(os.environ["GPU_CHECK_MODEL"])
    return {"folder": str(tiny_models.stable_diffusion(folder, sizes=sizes))}


def train_steps(args: argparse.Namespace) -> dict[str, Any]:
    """Train for some steps; without an overlay, also with networks that do nothing."""
    found = run_of(args, training_arguments(args))
    if found["waits"]:
        found["failed"] = f"a step waits for the GPU at {', '.join(found['waits'])}"
    if args.device == "cuda":
        found["peak_gb"] = round(torch.cuda.max_memory_allocated() / 2**30, 2)
    if os.environ["GPU_CHECK_OVERLAY"]:
        return found
    with empty_networks():
        found["empty_networks"] = run_of(args, training_arguments(args))
    share = found["empty_networks"]["ms_per_step"] / found["unet_ms"]
    return found | {"empty_step_over_unet": round(share, 3)}


def demos(args: argparse.Namespace) -> dict[str, Any]:
    return in_process("demo_runs", args)


def demo_runs(args: argparse.Namespace) -> dict[str, Any]:
    """Train as both demos do."""
    return {
        config: guarded(lambda _, config=config: run_of(args, demo_arguments(args, config)), args)
        for config in DEMOS
    }


def demo_arguments(args: argparse.Namespace, config: str) -> list[str]:
    """Return the arguments of a demo without a turntable, which plays no part in training."""
    options = {"data.n_test_views": 1, "system.exporter.save_video": "false"} | DEMOS[config]
    if args.small:
        options |= SMALL_PICTURES | SMALL_DEMOS[config] | {"trainer.max_steps": 6}
    return launcher_arguments(args, [config], options)


def run_of(args: argparse.Namespace, arguments: list[str]) -> dict[str, Any]:
    """Run the launcher; return what a :class:`StepProbe` found, the seconds of the run, and PSNR on
    held-out views if the guidance knows a truth.
    """
    from threestudio_gaussiandreamer.guidance.stable_diffusion import StableDiffusionGuidance
    from threestudio_gaussiandreamer.launch import experiment
    from threestudio_gaussiandreamer.training.system import GaussianDreamerSystem

    probe, started = StepProbe(args), time.perf_counter()
    with tempfile.TemporaryDirectory() as folder, contextlib.ExitStack() as patches:
        for owner, name in (
            (GaussianDreamerSystem, "training_step"),
            (StableDiffusionGuidance, "run_network"),
            (StableDiffusionGuidance, "_encode"),
        ):
            call = getattr(probe, name)(getattr(owner, name))
            patches.enter_context(unittest.mock.patch.object(owner, name, call))
        code = experiment.main([*arguments, f"exp_root_dir={folder}"])
        seconds = time.perf_counter() - started
        scores = [json.loads(path.read_text()) for path in Path(folder).glob("*/*/**/metrics.json")]
    if code:
        raise RuntimeError(f"the launcher ended with {code}")
    quality = {"psnr": round(scores[0]["result"]["psnr"], 2)} if scores else {}
    return probe.found() | quality | {"seconds": round(seconds, 1)}


class StepProbe:
    """Times the steps from ``first`` to ``last`` without waiting within them, and then records
    which lines wait for the GPU in one more step.
    """

    def __init__(self, args: argparse.Namespace) -> None:
        self.args, self.step = args, 0
        self.first, self.last = WINDOWS[args.small]
        self.times: dict[int, float] = {}
        self.unet: list[tuple[Any, Any]] = []
        self.vae: list[tuple[Any, Any]] = []
        self.waits: list[str] = []
        self.watch = contextlib.ExitStack()

    def training_step(self, original: Callable[..., Any]) -> Callable[..., Any]:
        def step(system: Any, *arguments: Any) -> Any:
            if self.step in (self.first, self.last):
                synchronize(self.args)
                self.times[self.step] = time.perf_counter()
            if self.step == self.last:
                self.watch.enter_context(waits_into(self.waits, self.args))
            if self.step == self.last + 1:
                self.watch.close()
            self.step += 1
            return original(system, *arguments)

        return step

    def run_network(self, original: Callable[..., Any]) -> Callable[..., Any]:
        def evaluate(*arguments: Any, **options: Any) -> Any:
            before = moment(self.args)
            result = original(*arguments, **options)
            self.note(self.unet, before)
            return result

        return evaluate

    def _encode(self, original: Callable[..., Any]) -> Callable[..., Any]:
        def encode(guidance: Any, images: Tensor) -> Tensor:
            images, before = images.view_as(images), moment(self.args)
            latents = original(guidance, images)
            self.note(self.vae, before)
            entered: list[Any] = []  # by the backward pass
            if latents.requires_grad:
                latents.register_hook(lambda _: entered.append(moment(self.args)))
                images.register_hook(lambda _: self.note(self.vae, *entered))
            return latents

        return encode

    def note(self, times: list[tuple[Any, Any]], before: Any) -> None:
        """Add the time since ``before``, if the step is one of those that are timed."""
        if self.first < self.step <= self.last:
            times.append((before, moment(self.args)))

    def found(self) -> dict[str, Any]:
        steps = self.last - self.first
        per_step = (self.times[self.last] - self.times[self.first]) / steps
        synchronize(self.args)
        unet, vae = (  # 0 without these networks
            sum(milliseconds(*both) for both in times) / steps for times in (self.unet, self.vae)
        )
        return {
            "ms_per_step": round(1e3 * per_step, 2),
            "unet_ms": round(unet, 3),
            "vae_ms": round(vae, 3),
            "other_ms": round(1e3 * per_step - unet - vae, 3),
            "waits": self.waits,
        }


def moment(args: argparse.Namespace) -> Any:
    """Return a point in time: of the GPU, or on a CPU in seconds."""
    if args.device != "cuda":
        return time.perf_counter()
    event = torch.cuda.Event(enable_timing=True)
    event.record()
    return event


def milliseconds(before: Any, after: Any) -> float:
    """Return the time between two moments."""
    if isinstance(before, float):
        return 1e3 * (after - before)
    return before.elapsed_time(after)


@contextlib.contextmanager
def waits_into(lines: list[str], args: argparse.Namespace) -> Iterator[None]:
    """Append the lines of this repository at which torch waits for the GPU."""

    def note(message: Any, *_: Any, **__: Any) -> None:
        if "called a synchronizing" not in str(message):
            return
        ours = (__file__, warnings.__file__)
        frames = [frame for frame in traceback.extract_stack() if frame.filename not in ours]
        own = [
            frame
            for frame in frames
            if Path(frame.filename).is_relative_to(ROOT) and "site-packages" not in frame.filename
        ]
        called = "" if frames[-1] is own[-1] else f" in {frames[-1].filename}:{frames[-1].lineno}"
        place = f"{Path(own[-1].filename).relative_to(ROOT)}:{own[-1].lineno}"
        lines.append(f"{place} {own[-1].line}{called}")

    if args.device != "cuda":
        yield
        return
    with warnings.catch_warnings(), unittest.mock.patch.object(warnings, "showwarning", note):
        warnings.simplefilter("always")
        torch.cuda.set_sync_debug_mode("warn")
        try:
            yield
        finally:
            torch.cuda.set_sync_debug_mode("default")


@contextlib.contextmanager
def empty_networks() -> Iterator[None]:
    """Replace the U-Net by zeros and the VAE by means of 8 x 8 pixels."""
    from threestudio_gaussiandreamer.guidance.stable_diffusion import StableDiffusionGuidance

    def zeros(self: Any, z: Tensor, *_: Any, **__: Any) -> Tensor:
        return torch.zeros_like(z)

    def pooled(self: Any, images: Tensor) -> tuple[Tensor, Tensor]:
        small = F.avg_pool2d(images, 8)
        latents = torch.cat([small, small[:, :1]], 1)
        return latents, torch.zeros_like(latents)

    patch = unittest.mock.patch.object
    with (
        patch(StableDiffusionGuidance, "run_network", zeros),
        patch(StableDiffusionGuidance, "_moments", pooled),
    ):
        yield


def training_arguments(args: argparse.Namespace) -> list[str]:
    """Return a few steps of the paper's configuration with a mesh instead of Shap-E, which plays no
    part in a step.
    """
    configs = filter(None, ("gaussiandreamer.yaml", os.environ["GPU_CHECK_OVERLAY"]))
    sizes = (
        {"data.width": 64, "data.height": 64, "system.geometry.grow.num_candidates": 2000}
        if args.small
        else {}
    )
    options = sizes | SMALL_PICTURES | {
        "system.prompt_processor.prompt": "a fox",
        "system.prompt_processor.pretrained_model_name_or_path": os.environ["GPU_CHECK_MODEL"],
        "system.guidance.pretrained_model_name_or_path": os.environ["GPU_CHECK_MODEL"],
        "system.geometry.prior_type": "mesh-prior", "system.geometry.prior.path": "toy.glb",
        "system.geometry.prior.num_points": 500 if args.small else 80_000,
        "system.geometry.grow.max_points": 100 if args.small else 20_000,
        "trainer.max_steps": WINDOWS[args.small][1] + 2, "trainer.val_check_interval": 100_000,
        "data.n_test_views": 1, "system.exporter.save_video": "false",
    }  # fmt: skip
    return launcher_arguments(args, configs, options)


def launcher_arguments(
    args: argparse.Namespace, configs: Iterable[str], options: dict[str, Any]
) -> list[str]:
    """Return the arguments of a training run without a progress bar."""
    options = options | {"trainer.enable_progress_bar": "false"}
    overlays = [part for name in configs for part in ("--config", name)]
    device = [] if args.device == "cuda" else ["--gpu", "cpu"]
    return [*overlays, "--train", *device, *(f"{key}={value}" for key, value in options.items())]
