"""Extension that divides the processor seconds of training steps among their parts, and ends the
run after the last one.

``launched.py`` copies this file beside a run. ``STEP_WINDOWS`` has the first and the last step of
each window, in order. The printed JSON has a list of the seconds of each part for every window,
without those of the parts that it calls. The progress bar is that of a terminal, and no checkpoint
is written, since those are due by the clock."""

import functools
import importlib
import json
import os
import sys
import time
from dataclasses import dataclass
from typing import Any

import torch
import torch.nn.functional as F

from threestudio_gaussiandreamer.guidance.base import ScoreDistillation
from threestudio_gaussiandreamer.guidance.text_to_image import TextToImageDistillation
from threestudio_gaussiandreamer.host import find, pl, register
from threestudio_gaussiandreamer.launch import callbacks

PACKAGE = "threestudio_gaussiandreamer."
MARK = "MEASURED "
STEPS = [int(step) for step in os.environ["STEP_WINDOWS"].split()]
FIRSTS, LASTS = STEPS[::2], STEPS[1::2]
SYSTEM = find("gaussiandreamer-system")
DIFFUSION = find("gaussiandreamer-stable-diffusion-guidance")
CALLS = {
    "rasteriser": (
        ("training.renderer", "rasterize"),
        ("splatting.autograd", "_Rasterize.backward"),
    ),
    # of the exact score, the pass that compares renders with the known pictures
    "network": (("splatting.cpu.known_picture", "known_gradient"),),
    "rest of the score": (("training.system", "GaussianDreamerSystem.guide"),),
    "cameras": (("training.data", "TrainCameras.collate"),),
    "density control": (
        ("training.density", "DensityControl.before_backward"),
        ("training.density", "DensityControl.after_backward"),
        ("training.density", "DensityControl.after_step"),
    ),
    "logs and progress bar": (
        ("training.system", "GaussianDreamerSystem.report"),
        ("launch.callbacks", "ProgressBar.on_train_batch_end"),
    ),
    "renderer without the rasteriser": (("training.renderer", "SplattingRenderer.forward"),),
    "autograd without the rasteriser": (
        ("training.system", "GaussianDreamerSystem.manual_backward"),
    ),
}
OTHER = "loop and the rest"
OF_LIGHTNING = {
    "logs and progress bar": (
        (pl.callbacks.LearningRateMonitor, "on_train_batch_start"),
        (pl.loggers.CSVLogger, "log_metrics"),
        (pl.loggers.TensorBoardLogger, "log_metrics"),
    ),
}
seconds: dict[str, float] = dict.fromkeys([*CALLS, "optimiser", OTHER], 0.0)
found: list[dict[str, float]] = []
running, since = [OTHER], 0.0


def switch() -> None:
    """Add the time since the last switch to the part that is running."""
    global since
    now = time.process_time()
    seconds[running[-1]] += now - since
    since = now


def enter(part: str) -> None:
    switch()
    running.append(part)


def leave(part: str) -> None:
    switch()
    ended = running.pop()
    assert ended == part, (ended, part)


def measured(part: str, call: Any) -> Any:
    @functools.wraps(call)
    def within(*args: Any, **options: Any) -> Any:
        enter(part)
        try:
            return call(*args, **options)
        finally:
            leave(part)

    return within


def measure(part: str, owner: Any, name: str) -> None:
    static = isinstance(vars(owner).get(name), staticmethod)
    call = measured(part, getattr(owner, name))
    setattr(owner, name, staticmethod(call) if static else call)


def measure_calls() -> None:
    for part, places in CALLS.items():
        for module, path in places:
            *owners, name = path.split(".")
            owner = functools.reduce(getattr, owners, importlib.import_module(PACKAGE + module))
            measure(part, owner, name)
    for part, places in OF_LIGHTNING.items():
        for owner, name in places:
            measure(part, owner, name)


def measure_encoder(guidance: type) -> None:
    """Attribute both passes of a guidance's encoder to the network."""
    encode = measured("network", guidance.encode)

    @functools.wraps(encode)
    def measured_encode(guidance: Any, rgb: torch.Tensor, **batch: Any) -> torch.Tensor:
        pixels = rgb.view_as(rgb)  # its gradient is that of the encoder alone
        latents = encode(guidance, pixels, **batch)
        if latents.requires_grad:
            latents.register_hook(lambda grad: enter("network"))
            pixels.register_hook(lambda grad: leave("network"))
        return latents

    guidance.encode = measured_encode


def configured(build: Any) -> Any:
    """Measure the steps of the optimiser that ``build`` makes."""

    @functools.wraps(build)
    def configure(system: Any) -> Any:
        optimizer = build(system)
        measure("optimiser", type(optimizer), "step")
        return optimizer

    return configure


def before_a_batch(begin: Any) -> Any:
    @functools.wraps(begin)
    def on_train_batch_start(system: Any, *args: Any) -> Any:
        switch()
        if system.global_step in LASTS:
            assert running == [OTHER], running
            found.append(dict(seconds))
        if system.global_step == STEPS[-1]:
            print(f"\n{MARK}{json.dumps({'windows': found})}", flush=True)
            os._exit(0)
        if system.global_step in FIRSTS:
            seconds.update(dict.fromkeys(seconds, 0.0))
        return begin(system, *args)

    return on_train_batch_start


@register("empty-networks-guidance")
class EmptyNetworks(ScoreDistillation):
    """Stable Diffusion's shapes with networks that do nothing: the autoencoder averages blocks of
    8 x 8 pixels to 4 channels, the U-Net predicts zeros.
    """

    @dataclass
    class Config(ScoreDistillation.Config):
        mesh: str = ""  # as in demo.yaml
        mode: str = ""

    cfg: Config

    def encode(self, rgb: torch.Tensor, **batch: Any) -> torch.Tensor:
        pooled = F.avg_pool2d(rgb, 8)
        return torch.cat([pooled, pooled[:, :1]], 1) * 2 - 1

    def decode(self, latents: torch.Tensor) -> torch.Tensor:
        return latents[:, :3]

    def condition(self, prompt_utils: Any, **batch: Any) -> None:
        return None

    def predict(self, z: torch.Tensor, t: torch.Tensor, condition: None) -> tuple:
        return torch.zeros_like(z), None


callbacks.SECONDS_BETWEEN = float("inf")
sys.stderr.isatty = lambda: True
measure_calls()
measure("network", TextToImageDistillation, "run_network")
measure("network", EmptyNetworks, "predict")
for guidance in (DIFFUSION, EmptyNetworks):
    measure_encoder(guidance)
SYSTEM.configure_optimizers = configured(SYSTEM.configure_optimizers)
SYSTEM.on_train_batch_start = before_a_batch(SYSTEM.on_train_batch_start)
since = time.process_time()
