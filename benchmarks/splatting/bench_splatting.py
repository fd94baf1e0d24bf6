"""Time and memory of the rasteriser on one synthetic scene: `make bench`.

A torus shell with a sphere in its hole, seen once, at several sizes; forward, and forward with
backward (gradients of all five attributes from image, depth and alpha). Every cell is a process of
its own, so that its memory can be measured; contenders alternate, so that all have the same load.
Prints a table and writes ``benchmarks/results/splatting.csv``.

Contenders: ``cpu`` (the best build for this processor), ``cpu-v3`` and ``cpu-base`` (builds for
older ones), ``torch``, and ``gsplat`` (its plain-torch functions, see
gsplat_reference.py). gsplat's functions keep every pair of Gaussian and pixel (3 GB at 100,000 and
512^2), so that pictures larger than --gsplat-size are left to the others."""

import argparse
import csv
import importlib.util
import json
import math
import os
import pathlib
import platform
import shutil
import statistics
import subprocess
import sys
import time
from typing import Callable

import torch
from torch import Tensor

from benchmarks.quality.runs import machine
from benchmarks.splatting.bench_scenes import Scene, make_camera, make_cotangents, make_scene

ROOT = pathlib.Path(__file__).resolve().parents[2]
CONTENDERS = ("cpu", "cpu-v3", "cpu-base", "torch", "gsplat")
COLUMNS = ("gaussians", "size", "threads", "contender", "forward_ms", "both_ms", "memory_mb")
COLUMNS += ("load",)


# ---- one cell, in its own process ----------------------------------------------------------------


def contender(
    name: str, size: int, preset: str, threads: int
) -> Callable[[Scene], tuple[Tensor, ...]]:
    """Return a function that renders a scene: image, depth, alpha."""
    viewmat, K = make_camera(size)
    if name == "gsplat":
        from benchmarks.splatting.gsplat_reference import drawer

        return drawer(viewmat, K, size)
    if name.startswith("cpu-"):
        os.environ["GAUSSIANDREAMER_ISA"] = name.removeprefix("cpu-")
    from threestudio_gaussiandreamer.splatting import rasterize

    def draw(scene: Scene) -> tuple[Tensor, ...]:
        out = rasterize(
            *scene,
            viewmat[None],
            K[None],
            size,
            size,
            preset=preset,
            backend=name.partition("-")[0],
        )
        return out.image, out.depth, out.alpha

    return draw


def measure(
    draw: Callable, leaves: Scene, cotangents: list[Tensor], seconds: float
) -> dict[str, float]:
    """Return the medians of forward and of forward with backward in milliseconds, and the peak
    memory above inputs and libraries in MB.
    """
    reset_peak()
    before, rows, start = memory_now("VmRSS"), [], time.perf_counter()
    while len(rows) < 3 or (time.perf_counter() - start < seconds and len(rows) < 60):
        rows.append(_step(draw, leaves, cotangents))
    forward, both = (1e3 * statistics.median(column) for column in zip(*rows[1:], strict=True))
    return {"forward_ms": forward, "both_ms": both, "memory_mb": memory_now("VmHWM") - before}


def _step(draw: Callable, leaves: Scene, cotangents: list[Tensor]) -> tuple[float, float]:
    for leaf in leaves:
        leaf.grad = None
    start = time.perf_counter()
    pictures = draw(leaves)
    middle = time.perf_counter()
    torch.autograd.backward(pictures, cotangents)
    return middle - start, time.perf_counter() - start


def memory_now(field: str) -> float:
    """Return MB from /proc/self/status; NaN if it does not exist."""
    status = pathlib.Path("/proc/self/status")
    if not status.exists():
        return math.nan
    return next(
        int(line.split()[1]) / 1024
        for line in status.read_text().splitlines()
        if line.startswith(field)
    )


def reset_peak() -> None:
    peak = pathlib.Path("/proc/self/clear_refs")
    if peak.exists():
        peak.write_text("5")


def make_leaves(gaussians: int) -> Scene:
    return Scene(*(x.requires_grad_() for x in make_scene(gaussians)))


def run_cell(
    name: str, gaussians: int, size: int, threads: int, preset: str, seconds: float
) -> None:
    torch.set_num_threads(threads)
    _step(
        contender(name, 16, preset, threads), make_leaves(64), make_cotangents(16)
    )  # loads the libraries
    cell = measure(
        contender(name, size, preset, threads),
        make_leaves(gaussians),
        make_cotangents(size),
        seconds,
    )
    print(json.dumps(cell))


# ---- the table -----------------------------------------------------------------------------------


def run_in_process(
    name: str, gaussians: int, size: int, threads: int, args: argparse.Namespace
) -> dict[str, float]:
    cell = ["--cell", name, str(gaussians), str(size), str(threads)]
    command = [
        sys.executable,
        "-m",
        "benchmarks.splatting.bench_splatting",
        *cell,
        "--preset",
        args.preset,
        "--seconds",
        str(args.seconds),
    ]
    done = subprocess.run(
        command,
        env=os.environ | {"OMP_WAIT_POLICY": "passive"},
        stdout=subprocess.PIPE,
        text=True,
        check=True,
    )
    return json.loads(done.stdout.splitlines()[-1])


def run_row(gaussians: int, size: int, threads: int, args: argparse.Namespace) -> list[dict]:
    """Run all contenders alternately; return the faster turn of each."""
    names = [name for name in args.contenders if name != "gsplat" or size <= args.gsplat_size]
    turns = [
        {name: run_in_process(name, gaussians, size, threads, args) for name in names}
        for _ in range(args.turns)
    ]
    where = {"gaussians": gaussians, "size": size, "threads": threads}
    best = {
        name: min((turn[name] for turn in turns), key=lambda cell: cell["both_ms"])
        for name in names
    }
    return [
        where | {"contender": name, "load": round(os.getloadavg()[0], 1)} | best[name]
        for name in names
    ]


def print_row(rows: list[dict]) -> None:
    first, fastest = rows[0], rows[0]["both_ms"]
    print(
        f"\n{first['gaussians']} Gaussians, {first['size']} x {first['size']}, "
        f"{first['threads']} threads, load {first['load']}"
    )
    for row in rows:
        times = f"forward {row['forward_ms']:9.2f} ms   with backward {row['both_ms']:9.2f} ms"
        print(
            f"  {row['contender']:10} {times}   {row['memory_mb']:7.0f} MB   "
            f"{row['both_ms'] / fastest:8.2f} x {first['contender']}",
            flush=True,
        )


def describe_machine() -> str:
    """Return processor, versions and commit, for the head of the table."""
    return (
        f"{processor()}, {os.cpu_count()} threads; Python {platform.python_version()}, torch "
        f"{torch.__version__}; commit {_commit() or 'unknown'}"
    )


def processor() -> str:
    """Return the processor's name and whether the kernel uses its AVX-512, since names such as
    "AMD EPYC" stand for several generations; the name alone if the kernel isn't built.
    """
    from threestudio_gaussiandreamer.splatting.cpu import backend as cpu

    builds = cpu.usable_builds()
    return machine() + (f" {'with' if 'v4' in builds else 'without'} AVX-512" if builds else "")


def _commit() -> str:
    """Return the commit; empty without git or outside a checkout."""
    git = shutil.which("git")
    if git is None:
        return ""
    return subprocess.run(
        [git, "-C", str(ROOT), "rev-parse", "--short", "HEAD"], capture_output=True, text=True
    ).stdout.strip()


def available(names: list[str]) -> list[str]:
    """Return the contenders that can run here, and log why others cannot."""
    from threestudio_gaussiandreamer.splatting.cpu import backend as cpu

    builds = cpu.usable_builds()
    missing = {
        name: f"no {name} build for this machine"
        for name in names
        if name.startswith("cpu") and name.partition("-")[2] not in ("", *builds)
    }
    if "gsplat" in names and importlib.util.find_spec("gsplat") is None:
        missing["gsplat"] = "pip install gsplat"
    if not builds:
        missing["cpu"] = cpu.unavailable()
    for name, reason in missing.items():
        print(f"without {name}: {reason}")
    return [name for name in names if name not in missing]


def write_csv(rows: list[dict], where: str) -> None:
    path = ROOT / "benchmarks" / "results" / "splatting.csv"
    path.parent.mkdir(exist_ok=True)
    with path.open("w", newline="") as file:
        file.write(f"# {where}\n")
        writer = csv.DictWriter(file, COLUMNS)
        writer.writeheader()
        writer.writerows(
            {
                key: round(value, 3) if isinstance(value, float) else value
                for key, value in row.items()
            }
            for row in rows
        )
    print(f"\nwritten to {path.relative_to(ROOT)}")


def parse(argv: list[str]) -> argparse.Namespace:
    numbers, words = lambda text: [int(x) for x in text.split(",")], lambda text: text.split(",")
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--gaussians", type=numbers, default=[5_000, 20_000, 100_000, 500_000])
    parser.add_argument("--sizes", type=numbers, default=[256, 512, 1024])
    parser.add_argument("--threads", type=numbers, default=[1, torch.get_num_threads()])
    parser.add_argument(
        "--contenders",
        type=words,
        default=list(CONTENDERS),
        help="the first one is the unit of the ratios",
    )
    parser.add_argument("--preset", default="fast", help="fast: the threshold of other libraries")
    parser.add_argument(
        "--gsplat-size", type=int, default=512, help="largest image for gsplat's functions"
    )
    parser.add_argument("--turns", type=int, default=2)
    parser.add_argument(
        "--seconds", type=float, default=2.0, help="per cell and turn, at least three steps"
    )
    parser.add_argument("--cell", nargs=4, help=argparse.SUPPRESS)
    return parser.parse_args(argv)


def main(argv: list[str]) -> None:
    args = parse(argv)
    if args.cell:
        name, *where = args.cell
        return run_cell(name, *map(int, where), args.preset, args.seconds)
    where = describe_machine()
    print(where)
    args.contenders = available(args.contenders)
    rows = []
    for gaussians in args.gaussians:
        for size in args.sizes:
            for threads in dict.fromkeys(args.threads):
                row = run_row(gaussians, size, threads, args)
                print_row(row)
                rows += row
    write_csv(rows, where)


if __name__ == "__main__":
    main(sys.argv[1:])
