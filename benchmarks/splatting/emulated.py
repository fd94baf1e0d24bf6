"""The CPU kernel on Linux on ARM, under emulation, beside this machine's and the specification.

    python -m benchmarks.splatting.emulated

Compiles the kernel for aarch64 with the flags of ``setup.py`` that concern arithmetic, draws and
differentiates scenes with it under ``qemu-aarch64``, and prints the largest difference of each
output, as a share of its largest value: from this machine's kernel, and from the float64
specification. Ends with exit code 1 if one exceeds :data:`BOUND`. Skips where the cross compiler or
the emulator is missing (Debian: ``apt install g++-aarch64-linux-gnu qemu-user``)."""

import ctypes
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import torch
from torch import Tensor

from benchmarks.splatting.bench_scenes import Scene, make_scene
from benchmarks.splatting.pairs import cameras_around, stacked
from benchmarks.splatting.scenes import needles, trained
from threestudio_gaussiandreamer.core.streams import generator
from threestudio_gaussiandreamer.splatting import RasterizeOptions, rasterize
from threestudio_gaussiandreamer.splatting.cpu import backend as cpu
from threestudio_gaussiandreamer.splatting.scene import Scene as splat_scene

COMPILER, EMULATOR = "aarch64-linux-gnu-g++", "qemu-aarch64"
FLAGS = (
    "-std=c++17 -O3 -pthread -static -ffp-contract=fast -fno-math-errno -fno-trapping-math"
).split()
BOUND = 1e-4
VIEWS, SIZE = 2, 48
PICTURES = ("image", "alpha", "depth")
GRADIENTS = ("means", "quats", "scales", "opacities", "viewmats", "colors")
PROGRAM = r"""
#include <cstdio>
#include <cstdlib>

#include "rasterize.cpp"

using Arrays = std::vector<std::vector<float>>;

static void read(void* to, size_t bytes) {
  if (fread(to, 1, bytes, stdin) != bytes) abort();
}

int main() {
  long long sizes[3];
  SplatSettings settings;
  read(sizes, sizeof sizes), read(&settings, sizeof settings);
  const size_t n = sizes[0], views = sizes[1], side = sizes[2], pixels = views * side * side;
  Arrays in, pictures, found;
  for (size_t count : {3 * n, 4 * n, 3 * n, n, 16 * views, 3 * n, 3 * views, 9 * views,
                       3 * pixels, pixels, pixels})
    in.emplace_back(count), read(in.back().data(), 4 * count);
  for (size_t count : {3 * pixels, pixels, pixels, 2 * n * views, n * views, n * views})
    pictures.emplace_back(count);
  for (size_t count : {3 * n, 4 * n, 3 * n, n, 16 * views, 3 * n, 2 * n * views})
    found.emplace_back(count);
  const auto i = [&](int k) { return in[k].data(); };
  const auto p = [&](int k) { return pictures[k].data(); };
  const auto f = [&](int k) { return found[k].data(); };
  const splat::Scene scene = {i(0), i(1), i(2), i(3), i(4), i(5), i(6), i(7),
                              sizes[0], int(views), int(side), int(side), 0};
  const SplatPictures out = {p(0), p(1), p(2), p(3), p(4), p(5)};
  const SplatUpstream upstream = {i(8), i(9), i(10)};
  const SplatGradients gradients = {f(0), f(1), f(2), f(3), f(4), f(5), f(6), nullptr};
  SplatState* state = nullptr;
  splat_set_memory(1ll << 32);
  if (splat_forward(&scene, &settings, &out, &state)) abort();
  if (splat_backward(state, &scene, &settings, &upstream, &gradients)) abort();
  for (int k = 0; k < 3; k++) fwrite(p(k), 4, pictures[k].size(), stdout);
  for (int k = 0; k < 6; k++) fwrite(f(k), 4, found[k].size(), stdout);
}
"""


def compile_program(folder: Path) -> Path:
    """Compile the kernel and a program that draws what it reads; return its path."""
    source, program = folder / "main.cpp", folder / "main"
    source.write_text(PROGRAM, encoding="utf-8")
    includes = [f"-I{cpu.FOLDER}", f"-I{cpu.FOLDER.parent / 'shared'}"]
    command = [COMPILER, *FLAGS, *includes, str(source), "-o", str(program)]
    subprocess.run(command, check=True)
    return program


def emulated(
    program: Path, cloud: Scene, cameras: list[Tensor], loss: list[Tensor]
) -> list[Tensor]:
    """Draw and differentiate with the program; return pictures, then gradients."""
    viewmats, Ks = cameras
    background = torch.zeros(VIEWS, 3)
    scene = splat_scene(*cloud[:4], viewmats, cloud.colors, background, Ks, SIZE, SIZE)
    options = RasterizeOptions()
    settings = options.struct(options.kernel_alpha_min, threads=2)
    sizes = (ctypes.c_longlong * 3)(len(cloud.means), VIEWS, SIZE)
    arrays = b"".join(x.numpy().tobytes() for x in (*scene.tensors, *loss))
    content = bytes(sizes) + bytes(settings) + arrays
    command = [EMULATOR, str(program)]
    answer = subprocess.run(command, input=content, stdout=subprocess.PIPE, check=True).stdout
    shapes = [x.shape for x in (*loss, *(getattr(scene, name) for name in GRADIENTS))]
    flat = torch.frombuffer(bytearray(answer), dtype=torch.float32)
    parts = flat.split([shape.numel() for shape in shapes])
    return [part.view(shape) for part, shape in zip(parts, shapes, strict=True)]


def drawn(
    backend: str, cloud: Scene, cameras: list[Tensor], loss: list[Tensor], dtype: torch.dtype
) -> list[Tensor]:
    """Draw and differentiate with a backend of this machine; return pictures, then gradients."""
    inputs = [
        x.to(dtype, copy=True).requires_grad_() for x in (*cloud[:4], cameras[0], cloud.colors)
    ]
    *geometry, viewmats, colors = inputs
    out = rasterize(*geometry, colors, viewmats, cameras[1].to(dtype), SIZE, SIZE, backend=backend)
    pictures = [getattr(out, name) for name in PICTURES]
    sum((a * b).sum() for a, b in zip(pictures, loss, strict=True)).backward()
    return [*(x.detach() for x in pictures), *(x.grad for x in inputs)]


def compare(program: Path, name: str, cloud: Scene) -> float:
    """Print the differences of one scene; return the largest."""
    cameras = list(stacked(cameras_around(VIEWS, SIZE)))
    rng = generator(0, "emulated")
    loss = [torch.rand(VIEWS, SIZE, SIZE, channels, generator=rng) for channels in (3, 1, 1)]
    arm = emulated(program, cloud, cameras, loss)
    here = drawn("cpu", cloud, cameras, loss, torch.float32)
    truth = drawn("reference", cloud, cameras, loss, torch.float64)
    worst = 0.0
    for label, ours, x86, true in zip((*PICTURES, *GRADIENTS), arm, here, truth, strict=True):
        largest = float(true.abs().max())
        from_here, from_truth = (
            float((ours.double() - other.double()).abs().max()) / largest for other in (x86, true)
        )
        print(f"{name:10} {label:10} {from_here:10.1e} {from_truth:14.1e}")
        worst = max(worst, from_here, from_truth)
    return worst


def main() -> int:
    for tool in (COMPILER, EMULATOR):
        if shutil.which(tool) is None:
            print(f"skipped: needs {tool}")
            return 0
    print(f"{'scene':10} {'output':10} {'this CPU':>10} {'specification':>14}")
    scenes = {"trained": trained(), "needles": needles(), "surface": make_scene(1000)}
    with tempfile.TemporaryDirectory() as folder:
        program = compile_program(Path(folder))
        worst = max(compare(program, name, cloud) for name, cloud in scenes.items())
    print(f"largest: {worst:.1e}; bound: {BOUND:.0e}")
    return int(worst > BOUND)


if __name__ == "__main__":
    sys.exit(main())
