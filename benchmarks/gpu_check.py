"""Everything that waits for an NVIDIA GPU, in one command of under ten minutes: `make gpu-check`.

    python benchmarks/gpu_check.py                          # exit 0: all well; 1: something failed; 2: no GPU
    python benchmarks/gpu_check.py --device cpu --small     # the same flow, tiny, on the CPU: does this script work?

========  ==================================================================================================================
section   what it does
========  ==================================================================================================================
compile   first use of the kernels with an empty cache, and a later start
correct   image and all gradients against plain torch in float64, on small and large clouds; the same bits again
sanitize  compute-sanitizer (memcheck, racecheck) on a small picture, where that tool exists
bench     4 views of 1024^2, 100,000 Gaussians, forward and backward, beside gsplat (its wheel is fetched, it builds here)
train     steps of configs/gaussiandreamer.yaml with a UNet and VAE of Stable Diffusion 2.1's size and random weights
========  ==================================================================================================================

A section that fails is recorded with its reason, and the others go on. Numbers go to benchmarks/results/gpu-<device>.json.
"""

import argparse
import json
import os
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from bench_splatting import Scene, describe_machine, make_camera, make_scene
from torch import Tensor

ROOT = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(ROOT), str(ROOT / "tests")]

TRIMMED = 0.005
"""The share of Gaussians, those with the worst gradients, that is left out: a rounding turns a pixel's alpha over the cut."""
GRADIENT_ERROR, IMAGE_ERROR = 2e-5, 1e-4
STEPS_OF_A_RUN = 1200
LIMITS = {"compile": 120, "sanitize": 150, "gsplat": 240, "train": 200}
"""Seconds for what runs in a process of its own."""


def main(argv: list[str]) -> int:
    args = parse_arguments(argv)
    if args.only:
        print(json.dumps(PARTS[args.only](args)))
        return 0
    if args.device == "cuda" and not torch.cuda.is_available():
        print(f"there is no NVIDIA GPU that torch {torch.__version__} can use; nothing was checked", file=sys.stderr)
        return 2
    report: dict[str, Any] = {"device": device_name(args), "machine": describe_machine(), "small": args.small}
    for name, section in SECTIONS.items():
        started = time.perf_counter()
        report[name] = guarded(section, args) | {"section_seconds": round(time.perf_counter() - started, 1)}
        print(f"{name:9} {json.dumps(report[name])}", flush=True)
    write(args, report)
    return int(any("failed" in report[name] for name in SECTIONS))


def parse_arguments(argv: list[str]) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", choices=("cuda", "cpu"), default="cuda")
    parser.add_argument("--small", action="store_true", help="tiny clouds, pictures and models, and nothing is fetched")
    parser.add_argument("--out", type=Path, help="default: benchmarks/results/gpu-<device>.json")
    parser.add_argument("--only", choices=PARTS, help=argparse.SUPPRESS)
    return parser.parse_args(argv)


def guarded(section: Callable[[argparse.Namespace], dict[str, Any]], args: argparse.Namespace) -> dict[str, Any]:
    """What a section found, or why it failed."""
    try:
        return section(args)
    except Exception as error:
        traceback.print_exc()
        return {"failed": f"{type(error).__name__}: {error}"[-2000:]}


def device_name(args: argparse.Namespace) -> str:
    return torch.cuda.get_device_name() if args.device == "cuda" else "cpu"


def write(args: argparse.Namespace, report: dict[str, Any]) -> None:
    safe = "".join(letter if letter.isalnum() else "-" for letter in report["device"])
    path = args.out or ROOT / f"benchmarks/results/gpu-{safe}.json"
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(report, indent=2) + "\n")
    print(f"written to {path}")


# ---- the rasteriser --------------------------------------------------------------------------------------------------------


def on(device: str, scene: Scene, dtype: torch.dtype = torch.float32) -> Scene:
    """The scene as leaves of a graph."""
    return Scene(*(x.detach().to(device, dtype).requires_grad_() for x in scene))


def cameras(size: int, views: int, device: str, dtype: torch.dtype = torch.float32) -> tuple[Tensor, Tensor]:
    viewmats, Ks = zip(*(make_camera(size, azimuth=30.0 + 360.0 * view / views) for view in range(views)), strict=True)
    return torch.stack(viewmats).to(device, dtype), torch.stack(Ks).to(device, dtype)


def drawn(scene: Scene, size: int, views: int, backend: str, **options: Any) -> tuple[Tensor, ...]:
    """Image, alpha, depth and the gradients of all attributes, for a fixed cotangent."""
    from threestudio_gaussiandreamer.splatting import rasterize

    viewmats, Ks = cameras(size, views, scene.means.device.type, scene.means.dtype)
    out = rasterize(*scene, viewmats, Ks, size, size, backend=backend, **options)
    pictures = (out.image, out.alpha, out.depth)
    rng = torch.Generator().manual_seed(size)
    cotangents = [torch.randn(x.shape, generator=rng, dtype=torch.float64).to(x) / size for x in pictures]
    return (*(x.detach() for x in pictures), *torch.autograd.grad(pictures, list(scene), cotangents))


def correct(args: argparse.Namespace) -> dict[str, Any]:
    """Each case against plain torch in float64, and against itself.

    Raises:
        AssertionError: a difference that rounding doesn't explain.
    """
    cases = [(300, 33, 2, {}), (2000, 64, 2, {"antialias": True}), (2000, 64, 1, {"downsample": 2, "preset": "accurate"})]
    cases += [] if args.small else [(20_000, 256, 2, {}), (100_000, 512, 1, {"preset": "fast"})]
    found = {}
    for count, size, views, options in cases:
        scene = make_scene(count)
        once, again = (drawn(on(args.device, scene), size, views, args.device, **options) for _ in range(2))
        if not all(torch.equal(a, b) for a, b in zip(once, again, strict=True)):
            raise AssertionError(f"{count} Gaussians at {size}^2: a second call gives other bits")
        exact = drawn(on(args.device, scene, torch.float64), size, views, "torch", **options)
        image = max(relative(a, b) for a, b in zip(once[:3], exact[:3], strict=True))
        gradient = max(trimmed(a, b) for a, b in zip(once[3:], exact[3:], strict=True))
        found[f"{count} at {size}^2 x {views}"] = {"image": image, "gradient": gradient}
        if image > IMAGE_ERROR or gradient > GRADIENT_ERROR:
            raise AssertionError(f"{count} Gaussians at {size}^2 {options}: image off by {image:.2e}, gradient by {gradient:.2e}")
    return {"relative_errors": found}


def relative(value: Tensor, exact: Tensor) -> float:
    return float((value.double() - exact).norm() / exact.norm())


def trimmed(value: Tensor, exact: Tensor) -> float:
    """The relative error without the worst Gaussians."""
    errors = (value.double() - exact).flatten(1).norm(dim=1) if value.ndim > 1 else (value.double() - exact).abs()
    kept = errors.sort().values[: max(1, int((1 - TRIMMED) * len(errors)))]
    return float(kept.norm() / exact.norm())


def compile_kernels(args: argparse.Namespace) -> dict[str, Any]:
    """Seconds from the first call to its picture, in new processes: with an empty cache, and with what that left."""
    with tempfile.TemporaryDirectory() as cache:
        environment = {"GAUSSIANDREAMER_CACHE": cache}
        return {name: in_process("first_picture", args, LIMITS["compile"], environment)["seconds"] for name in ("first", "later")}


def first_picture(args: argparse.Namespace) -> dict[str, Any]:
    scene = on(args.device, make_scene(1000))
    started = time.perf_counter()
    drawn(scene, 64, 1, args.device)
    synchronize(args)
    return {"seconds": round(time.perf_counter() - started, 3)}


def in_process(name: str, args: argparse.Namespace, limit: float, environment: dict[str, str], *prefix: str) -> dict[str, Any]:
    """One section in a process of its own."""
    command = [*prefix, sys.executable, __file__, "--only", name, "--device", args.device, *(["--small"] if args.small else [])]
    done = subprocess.run(command, env=os.environ | environment, capture_output=True, text=True, timeout=limit)
    if done.returncode:
        raise RuntimeError(f"{' '.join(command)} ended with {done.returncode}: {(done.stderr or done.stdout)[-1500:]}")
    return json.loads([line for line in done.stdout.splitlines() if line.startswith("{")][-1])


def sanitize(args: argparse.Namespace) -> dict[str, Any]:
    tool = shutil.which("compute-sanitizer") or next((p for p in ["/usr/local/cuda/bin/compute-sanitizer"] if os.path.exists(p)), None)
    if args.device != "cuda" or tool is None:
        return {"skipped": "there is no compute-sanitizer on the path"}
    uncached = {"PYTORCH_NO_CUDA_MEMORY_CACHING": "1"}  # torch's own allocator would hide what lies outside of a tensor
    for kind in ("memcheck", "racecheck"):
        in_process("first_picture", args, LIMITS["sanitize"], uncached, tool, "--tool", kind, "--error-exitcode", "1")
    return {"clean": ["memcheck", "racecheck"]}


# ---- speed -----------------------------------------------------------------------------------------------------------------


def synchronize(args: argparse.Namespace) -> None:
    if args.device == "cuda":
        torch.cuda.synchronize()


def timed(args: argparse.Namespace, call: Callable[[], Any], repetitions: int) -> dict[str, float]:
    """Milliseconds of a call, its quartiles, and the most memory that it took beyond what was there."""
    for _ in range(3):
        call()
    synchronize(args)
    before, seconds = 0, []
    if args.device == "cuda":
        torch.cuda.reset_peak_memory_stats()
        before = torch.cuda.memory_allocated()
    for _ in range(repetitions):
        started = time.perf_counter()
        call()
        synchronize(args)
        seconds.append(time.perf_counter() - started)
    low, middle, high = (round(1e3 * x, 3) for x in statistics.quantiles(seconds, n=4))
    memory = {"mb": round((torch.cuda.max_memory_allocated() - before) / 2**20, 1)} if args.device == "cuda" else {}
    return {"ms": middle, "q1": low, "q3": high} | memory


def bench(args: argparse.Namespace) -> dict[str, Any]:
    """Ours at every preset, and gsplat, forward with backward."""
    count, size, views = (500, 32, 2) if args.small else (100_000, 1024, 4)
    scene, repetitions = on(args.device, make_scene(count)), 4 if args.small else 50
    found: dict[str, Any] = {"gaussians": count, "size": size, "views": views}
    for preset in ("fast", "balanced", "accurate"):
        found[preset] = timed(args, lambda preset=preset: drawn(scene, size, views, args.device, preset=preset), repetitions)
    if args.device != "cuda" or args.small:
        return found | {"gsplat": {"skipped": "needs a GPU"}}
    found["gsplat"] = guarded(gsplat, args)
    if "failed" in found["gsplat"]:  # a peer that doesn't build here is no failure of ours
        found["gsplat"] = {"unavailable": found["gsplat"]["failed"]}
    else:
        found["times_faster_than_gsplat"] = round(found["gsplat"]["ms"] / found["fast"]["ms"], 2)
    return found


def gsplat(args: argparse.Namespace) -> dict[str, Any]:
    """gsplat of PyPI, installed into a folder of its own; its kernels are built at first use."""
    with tempfile.TemporaryDirectory() as folder:
        pip = [sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--target", folder, "gsplat", "ninja", "rich", "jaxtyping"]
        subprocess.run(pip, check=True, capture_output=True, timeout=LIMITS["gsplat"])
        return in_process("gsplat_steps", args, LIMITS["gsplat"], {"PYTHONPATH": folder})


def gsplat_steps(args: argparse.Namespace) -> dict[str, Any]:
    from gsplat import rasterization

    scene = on(args.device, make_scene(100_000))
    viewmats, Ks = cameras(1024, 4, args.device)

    def step() -> None:
        pictures, alphas, _ = rasterization(*scene, viewmats, Ks, 1024, 1024, render_mode="RGB+D", packed=False)
        torch.autograd.grad((pictures, alphas), list(scene), (torch.ones_like(pictures), torch.ones_like(alphas)))

    return timed(args, step, 50)


# ---- a training step -------------------------------------------------------------------------------------------------------


def train(args: argparse.Namespace) -> dict[str, Any]:
    """Seconds per step and memory of the paper's configuration, whole and for little memory."""
    import tiny_models

    with tempfile.TemporaryDirectory() as folder:
        model = tiny_models.stable_diffusion(
            Path(folder) / "model", sizes=tiny_models.TINY if args.small else tiny_models.STABLE_DIFFUSION_2_1
        )
        return {
            name: in_process("train_steps", args, LIMITS["train"], {"GPU_CHECK_MODEL": str(model), "GPU_CHECK_OVERLAY": overlay})
            for name, overlay in (("default", ""), ("lowmem", "gaussiandreamer-lowmem.yaml"))
        }


def train_steps(args: argparse.Namespace) -> dict[str, Any]:
    """A short run of the launcher itself; the first steps, which warm up, aren't counted."""
    from threestudio_gaussiandreamer import experiment, system

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
    memory = {"peak_gb": round(torch.cuda.max_memory_allocated() / 2**30, 2)} if args.device == "cuda" else {}
    return {
        "seconds_per_step": round(per_step, 4),
        "extrapolated_minutes_for_1200_steps": round(per_step * STEPS_OF_A_RUN / 60, 2),
    } | memory


def training_arguments(args: argparse.Namespace, folder: str) -> list[str]:
    """The paper's configuration from a mesh in the place of Shap-E, which has no part in a step."""
    overlays = [part for name in ("gaussiandreamer.yaml", os.environ["GPU_CHECK_OVERLAY"]) if name for part in ("--config", name)]
    steps = 4 if args.small else 16
    sizes = {"data.width": 64, "data.height": 64, "system.geometry.grow.num_candidates": 2000} if args.small else {}
    options = sizes | {
        "exp_root_dir": folder, "system.prompt_processor.prompt": "a fox",
        "system.prompt_processor.pretrained_model_name_or_path": os.environ["GPU_CHECK_MODEL"],
        "system.guidance.pretrained_model_name_or_path": os.environ["GPU_CHECK_MODEL"],
        "system.geometry.prior_type": "mesh-prior", "system.geometry.prior.path": "toy.glb",
        "system.geometry.prior.num_points": 500 if args.small else 80_000,
        "system.geometry.grow.max_points": 100 if args.small else 20_000,
        "trainer.max_steps": steps, "trainer.val_check_interval": 100_000, "trainer.enable_progress_bar": "false",
        "data.n_test_views": 1, "data.eval_width": 64, "data.eval_height": 64, "system.exporter.save_video": "false",
    }  # fmt: skip
    device = [] if args.device == "cuda" else ["--gpu", "cpu"]
    return [*overlays, "--train", *device, *(f"{key}={value}" for key, value in options.items())]


SECTIONS: dict[str, Callable[[argparse.Namespace], dict[str, Any]]] = {
    "compile": compile_kernels,
    "correct": correct,
    "sanitize": sanitize,
    "bench": bench,
    "train": train,
}
PARTS = {"first_picture": first_picture, "gsplat_steps": gsplat_steps, "train_steps": train_steps}
"""What runs in processes of its own."""


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
