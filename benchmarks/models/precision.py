"""Processor time of the bundled models' networks in float32 and bfloat16, in both memory formats.

    python -m benchmarks.models.precision [--rounds 7]

Calls of one training step of toybox.yaml without view contrast, one thread: the autoencoder's
encoder on 4 pictures of 128 x 128 with its gradient, and the U-Net on 8 latents. Weights and inputs
are of the precision's type, as with ``half_precision_on_cpu``. The settings alternate; ``cpu_ms``
is the median of the rounds, ``error`` the largest difference to float32, relative to the largest
value. Writes ``benchmarks/results/precision.csv``."""

import argparse
import itertools
import statistics
import time
from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from benchmarks.markdown import markdown, read, write
from benchmarks.quality.runs import ROOT, commit, machine
from threestudio_gaussiandreamer.models.bundled import FOLDER

RESULTS = ROOT / "benchmarks/results/precision.csv"
COLUMNS = ("network", "format", "precision", "cpu_ms", "error", "machine", "commit")
FORMATS = {"contiguous": torch.contiguous_format, "channels last": torch.channels_last}
PRECISIONS = {"float32": torch.float32, "bfloat16": torch.bfloat16}
VIEWS = 4


class Setting(NamedTuple):
    network: str
    format: str
    precision: str


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rounds", type=int, default=7)
    rounds = parser.parse_args().rounds
    torch.set_num_threads(1)
    calls = {precision: networks(dtype) for precision, dtype in PRECISIONS.items()}
    names = (calls["float32"], FORMATS, PRECISIONS)
    settings = [Setting(*values) for values in itertools.product(*names)]
    times: dict[Setting, list[float]] = {setting: [] for setting in settings}
    found: dict[Setting, Tensor] = {}
    for _ in range(rounds + 1):  # the first one isn't counted
        for setting in settings:
            seconds, found[setting] = timed(calls[setting.precision][setting.network], setting)
            times[setting].append(seconds)
    write(RESULTS, COLUMNS, (row_of(own, times[own][1:], found) for own in settings))


class Network(NamedTuple):
    module: torch.nn.Module
    call: Callable[[torch.memory_format], Tensor]
    """Calls the module with inputs in a memory format."""


def networks(dtype: torch.dtype) -> dict[str, Network]:
    from diffusers import AutoencoderKL, UNet2DConditionModel

    folder = FOLDER / "stable-diffusion"
    vae = AutoencoderKL.from_pretrained(folder / "vae", torch_dtype=dtype).requires_grad_(False)
    unet = UNet2DConditionModel.from_pretrained(folder / "unet", torch_dtype=dtype)
    unet.requires_grad_(False)
    generator = torch.Generator().manual_seed(0)
    images = torch.rand(VIEWS, 3, 128, 128, generator=generator).to(dtype)
    latents = torch.randn(2 * VIEWS, 4, 16, 16, generator=generator).to(dtype)
    width = unet.config.cross_attention_dim
    tokens = torch.randn(2 * VIEWS, 32, width, generator=generator).to(dtype)

    def encode(layout: torch.memory_format) -> Tensor:
        pixels = images.clone(memory_format=layout).requires_grad_()
        vae.encode(pixels).latent_dist.mean.float().sum().backward()
        return pixels.grad

    @torch.no_grad()
    def predict(layout: torch.memory_format) -> Tensor:
        noisy = latents.contiguous(memory_format=layout)
        times = torch.full((2 * VIEWS,), 300)
        return unet(noisy, times, encoder_hidden_states=tokens).sample

    return {"encoder and its gradient": Network(vae, encode), "U-Net": Network(unet, predict)}


def timed(network: Network, setting: Setting) -> tuple[float, Tensor]:
    layout = FORMATS[setting.format]
    network.module.to(memory_format=layout)
    start = time.process_time()
    result = network.call(layout)
    return time.process_time() - start, result.float()


def row_of(setting: Setting, times: list[float], found: dict[Setting, Tensor]) -> dict[str, str]:
    exact = found[Setting(setting.network, "contiguous", "float32")]
    error = float((found[setting] - exact).abs().max() / exact.abs().max())
    numbers = {"cpu_ms": f"{1000 * statistics.median(times):.1f}", "error": f"{error:.1e}"}
    return setting._asdict() | numbers | {"machine": machine(), "commit": commit()}


def table() -> str:
    """Return the table of docs/distillation.md."""
    head = ("network", "memory format", "precision", "CPU ms", "largest relative error")
    keys = ("network", "format", "precision", "cpu_ms", "error")
    return markdown(head, [tuple(row[key] for key in keys) for row in read(RESULTS)])


if __name__ == "__main__":
    main()
