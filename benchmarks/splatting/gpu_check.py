"""All checks and measurements that need an NVIDIA GPU, in one command: `make gpu-check`.

    python -m benchmarks.splatting.gpu_check
    python -m benchmarks.splatting.gpu_check --device cpu --small     # tests this script itself

The exit code is 0 if all is well, 1 if something failed, and 2 without a GPU.

========  ==========================================================================================
section   what it does
========  ==========================================================================================
compile   first use of the kernels with an empty cache, a later start, and the comparison with
          plain torch that precedes the first use
correct   image and all gradients against plain torch in float64, on small and large clouds; the
          same bits again; plain torch in float32, the fallback, on a small cloud
sanitize  compute-sanitizer (memcheck, racecheck) on a small picture, where that tool exists
bench     4 views of 1024^2, 100,000 Gaussians, forward and backward, beside gsplat (as installed,
          else its wheel is fetched; it builds here, which takes nvcc); one view of 1,000,000
prune     the prune command on a cloud of 100,000, to a quarter: seconds, dB, and the same bits
          again
train     steps of configs/gaussiandreamer.yaml with a UNet and VAE of Stable Diffusion 2.1's size
          and random weights, and with networks that do nothing; lines that wait for the GPU
demos     whole runs of configs/demo.yaml and configs/toybox.yaml
========  ==========================================================================================

Whatever touches the GPU runs in a process of its own, with a limit of its own and within --minutes:
a kernel that hangs or ruins its context costs that part alone. What fails is recorded with the end
of what it printed, and the others go on. The numbers go to benchmarks/results/gpu-<device>.json (or
--out) after each section. `compile`, `correct`, `sanitize` and `bench` need torch, NumPy, SciPy and
jaxtyping; without gsplat and a network to fetch it, `bench` times this package alone. `prune`,
`train` and `demos` need what the package depends on, such as Lightning and OmegaConf; `train` and
the run of toybox.yaml in `demos` need diffusers and transformers as well. Where `make` can't
install these, use `python -m benchmarks.splatting.gpu_check --sections compile correct sanitize
bench`."""

import argparse
import json
import signal
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch

from benchmarks.splatting import gpu_kernels, gpu_prune, gpu_training
from benchmarks.splatting.bench_splatting import describe_machine
from benchmarks.splatting.gpu_processes import failures, guarded, in_process

ROOT = Path(__file__).resolve().parents[2]
Section = Callable[[argparse.Namespace], dict[str, Any]]


def main(argv: list[str]) -> int:
    args = parse_arguments(argv)
    if args.only:
        args.out.write_text(json.dumps(PARTS[args.only](args)))
        return 0
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))  # so that parts end with this process
    report: dict[str, Any] = {
        "machine": describe_machine(),
        "small": args.small,
        "device": args.device,
    }
    if args.device == "cuda" and not torch.cuda.is_available():
        report["failed"] = f"nothing was checked: {reason_without_gpu()}"
        print(report["failed"], file=sys.stderr)
        if args.out:
            write(args, report)
        return 2
    report |= guarded(about, args)
    report |= earlier_sections(args, report)
    for name in args.sections:
        started = time.monotonic()
        report[name] = guarded(SECTIONS[name], args) | {
            "section_seconds": round(time.monotonic() - started, 1),
            "machine": report["machine"],
        }
        print(f"{name:9} {json.dumps(report[name])}", flush=True)
        write(args, report)
    return int(any(failures(report)))


def parse_arguments(argv: list[str]) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--device", choices=("cuda", "cpu"), default="cuda")
    parser.add_argument(
        "--small",
        action="store_true",
        help="tiny clouds, pictures and models, and nothing is fetched",
    )
    parser.add_argument(
        "--sections",
        nargs="+",
        choices=SECTIONS,
        default=list(SECTIONS),
        help="only these; the report keeps its others",
    )
    parser.add_argument(
        "--minutes",
        type=float,
        default=9.0,
        help="limit for everything; later parts are recorded as skipped",
    )
    parser.add_argument("--out", type=Path, help="default: benchmarks/results/gpu-<device>.json")
    parser.add_argument("--only", choices=PARTS, help=argparse.SUPPRESS)
    args = parser.parse_args(argv)
    args.deadline = time.monotonic() + 60 * args.minutes
    return args


def place(args: argparse.Namespace, report: dict[str, Any]) -> Path:
    """Return the path of the report."""
    safe = "".join(letter if letter.isalnum() else "-" for letter in report["device"])
    return args.out or ROOT / f"benchmarks/results/gpu-{safe}.json"


def earlier_sections(args: argparse.Namespace, report: dict[str, Any]) -> dict[str, Any]:
    """Return the sections of an earlier report that are not asked for, with their machine."""
    path = place(args, report)
    earlier = json.loads(path.read_text()) if path.is_file() else {}
    kept = [name for name in SECTIONS if name in earlier.keys() - args.sections]
    return {name: {"machine": earlier["machine"]} | earlier[name] for name in kept}


def write(args: argparse.Namespace, report: dict[str, Any]) -> None:
    path = place(args, report)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(report, indent=2) + "\n")
    print(f"written to {path}", flush=True)


def about(args: argparse.Namespace) -> dict[str, Any]:
    return in_process("about", args)


def describe_device(args: argparse.Namespace) -> dict[str, Any]:
    """Return the GPU, the releases that must match, and why the kernels can't run, or None."""
    from threestudio_gaussiandreamer.splatting import available_backends
    from threestudio_gaussiandreamer.splatting.cuda import driver as cuda_driver
    from threestudio_gaussiandreamer.splatting.cuda import nvrtc

    if args.device == "cpu":
        return {"device": "cpu"}
    properties = torch.cuda.get_device_properties(0)
    return {
        "device": properties.name,
        "compute_capability": f"{properties.major}.{properties.minor}",
        "memory_gb": round(properties.total_memory / 2**30, 1),
        "torch_cuda": torch.version.cuda,
        "driver": cuda_driver.driver_build().strip() or None,
        "driver_cuda": guarded(lambda _: {"release": cuda_driver.driver_version()}, args),
        "nvrtc": guarded(
            lambda _: {"release": nvrtc.version(), "library": nvrtc._library()._name}, args
        ),
        "kernels_unavailable": available_backends()["cuda"],
    }


def reason_without_gpu() -> str:
    from threestudio_gaussiandreamer.splatting import available_backends

    return available_backends()["cuda"] or "torch.cuda.is_available() is false"


SECTIONS: dict[str, Section] = {
    "compile": gpu_kernels.compile_kernels,
    "correct": gpu_kernels.correct,
    "sanitize": gpu_kernels.sanitize,
    "bench": gpu_kernels.bench,
    "prune": gpu_prune.prune,
    "train": gpu_training.train,
    "demos": gpu_training.demos,
}
PARTS: dict[str, Section] = {
    "about": describe_device,
    "first_picture": gpu_kernels.first_picture,
    "comparison": gpu_kernels.comparison,
    "errors": gpu_kernels.errors,
    "fallback": gpu_kernels.fallback,
    "speed": gpu_kernels.speed,
    "gsplat_steps": gpu_kernels.gsplat_steps,
    "prune_twice": gpu_prune.prune_twice,
    "make_model": gpu_training.make_model,
    "train_steps": gpu_training.train_steps,
    "demo_runs": gpu_training.demo_runs,
}


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
