"""Everything that waits for an NVIDIA GPU, in one command of under ten minutes: `make gpu-check`.

    python -m benchmarks.splatting.gpu_check                          # exit 0: all well; 1:
                                                            something failed; 2: no GPU
    python -m benchmarks.splatting.gpu_check --device cpu --small     # the same flow, tiny, on the
                                                            CPU: does this script work?

========  ==========================================================================================
section   what it does
========  ==========================================================================================
compile   first use of the kernels with an empty cache, and a later start
correct   image and all gradients against plain torch in float64, on small and large clouds; the
          same bits again
sanitize  compute-sanitizer (memcheck, racecheck) on a small picture, where that tool exists
bench     4 views of 1024^2, 100,000 Gaussians, forward and backward, beside gsplat (as installed,
          else its wheel is fetched; it builds here, which takes nvcc)
prune     the prune command on a cloud of 100,000, to a quarter: seconds, dB, and the same bits
          again
train     steps of configs/gaussiandreamer.yaml with a UNet and VAE of Stable Diffusion 2.1's size
          and random weights
========  ==========================================================================================

Whatever touches the GPU runs in a process of its own, with a limit of its own and within --minutes:
a kernel that hangs or ruins its context costs that part alone. What fails is recorded with the end
of what it printed, and the others go on. The numbers go to benchmarks/results/gpu-<device>.json (or
--out) after each section. All but `prune` and `train` needs no more than torch, NumPy, SciPy and
jaxtyping, so on a machine without a network `python -m benchmarks.splatting.gpu_check` does where
`make` can't install the rest."""

import argparse
import importlib.util
import json
import os
import shutil
import signal
import statistics
import subprocess
import sys
import tempfile
import time
import traceback
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from benchmarks.splatting.bench_scenes import Scene, make_camera, make_scene
from benchmarks.splatting.bench_splatting import describe_machine

ROOT = Path(__file__).resolve().parents[2]

TRIMMED = 0.005
"""The share of Gaussians, those with the worst gradients, that is left out: a rounding turns a
pixel's alpha over the cut.
"""
GRADIENT_ERROR, IMAGE_ERROR = 2e-5, 1e-4
STEPS_OF_A_RUN = 1200
SECONDS = {
    "about": 60,
    "first_picture": 60,
    "errors": 120,
    "sanitize": 90,
    "speed": 60,
    "pip": 90,
    "gsplat_steps": 240,
}
SECONDS |= {"prune_twice": 90, "make_model": 100, "train_steps": 150}
"""The most that each part may take."""
GSPLAT = ("gsplat", "ninja", "rich", "jaxtyping", "markdown-it-py", "mdurl", "pygments")
"""It and what it needs; without pip's own search for dependencies, which would fetch another torch.
"""
SANITIZERS = {
    "memcheck": ("--report-api-errors", "no"),
    "racecheck": (),
}  # torch asks for functions that a driver may not have
SANITIZER_FOUND = 99


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
    for name, section in SECTIONS.items():
        started = time.monotonic()
        report[name] = guarded(section, args) | {
            "section_seconds": round(time.monotonic() - started, 1)
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
        "--minutes",
        type=float,
        default=9.0,
        help="for everything; what comes too late is recorded as such",
    )
    parser.add_argument("--out", type=Path, help="default: benchmarks/results/gpu-<device>.json")
    parser.add_argument("--only", choices=PARTS, help=argparse.SUPPRESS)
    args = parser.parse_args(argv)
    args.deadline = time.monotonic() + 60 * args.minutes
    return args


def guarded(
    section: Callable[[argparse.Namespace], dict[str, Any]], args: argparse.Namespace
) -> dict[str, Any]:
    """What a section found, or why it failed."""
    try:
        return section(args)
    except Exception as error:
        traceback.print_exc()
        return {"failed": f"{type(error).__name__}: {error}"[-2000:]}


def failures(found: Any) -> Iterator[str]:
    """All that is called "failed", at any depth."""
    for key, value in found.items() if isinstance(found, dict) else ():
        yield from [str(value)] if key == "failed" else failures(value)


def write(args: argparse.Namespace, report: dict[str, Any]) -> None:
    safe = "".join(letter if letter.isalnum() else "-" for letter in report["device"])
    path = args.out or ROOT / f"benchmarks/results/gpu-{safe}.json"
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(report, indent=2) + "\n")
    print(f"written to {path}", flush=True)


# ---- parts in processes of their own -------------------------------------------------------------


def run(
    command: list[str], args: argparse.Namespace, limit: float, environment: dict[str, str]
) -> tuple[int, str]:
    """Exit status and output of a command. Neither it nor whatever it started outlives the limit.

    Raises:
        RuntimeError: it took too long, or there was no time for it.
    """
    limit = min(limit, args.deadline - time.monotonic())
    if limit <= 0:
        raise RuntimeError(f"the {args.minutes:g} minutes were over before {' '.join(command)}")
    with tempfile.TemporaryFile() as output:  # a pipe would stay open in a grandchild
        options = {
            "env": os.environ | environment,
            "stdout": output,
            "stderr": subprocess.STDOUT,
            "start_new_session": True,
        }
        process = subprocess.Popen(command, **options)
        try:
            status = process.wait(limit)
        except subprocess.TimeoutExpired:
            status = None
        finally:
            end_group(process)
        output.seek(0)
        text = output.read().decode(errors="replace")
    if status is None:
        raise RuntimeError(f"{' '.join(command)} took more than {limit:.0f} s: {text[-1500:]}")
    return status, text


def end_group(process: subprocess.Popen) -> None:
    try:
        os.killpg(process.pid, signal.SIGKILL)
    except ProcessLookupError:
        pass
    process.wait()


def in_process(
    name: str, args: argparse.Namespace, environment: dict[str, str] | None = None
) -> dict[str, Any]:
    """What a part found.

    Raises:
        RuntimeError: it didn't end well.
    """
    with tempfile.TemporaryDirectory() as folder:
        found = Path(folder) / "found.json"
        status, text = run(part_command(name, args, found), args, SECONDS[name], environment or {})
        if status:
            raise RuntimeError(f"{name} ended with {status}: {text[-1500:]}")
        return json.loads(found.read_text())


def part_command(name: str, args: argparse.Namespace, out: Path) -> list[str]:
    size = ["--small"] if args.small else []
    return [
        sys.executable,
        "-u",
        "-m",
        "benchmarks.splatting.gpu_check",
        "--only",
        name,
        "--device",
        args.device,
        "--out",
        str(out),
        *size,
    ]


def about(args: argparse.Namespace) -> dict[str, Any]:
    return in_process("about", args)


def describe_device(args: argparse.Namespace) -> dict[str, Any]:
    """The GPU, the releases that have to fit one another, and why our kernels can't run, or
    None.
    """
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
        "driver_cuda": guarded(lambda _: {"release": cuda_driver.driver_version()}, args),
        "nvrtc": guarded(
            lambda _: {"release": nvrtc.version(), "library": nvrtc._library()._name}, args
        ),
        "kernels_unavailable": available_backends()["cuda"],
    }


def reason_without_gpu() -> str:
    from threestudio_gaussiandreamer.splatting import available_backends

    return available_backends()["cuda"] or "torch.cuda.is_available() is false"


# ---- the rasteriser ------------------------------------------------------------------------------


def on(device: str, scene: Scene, dtype: torch.dtype = torch.float32) -> Scene:
    """The scene as leaves of a graph."""
    return Scene(*(x.detach().to(device, dtype).requires_grad_() for x in scene))


def cameras(size: int, views: int, scene: Scene) -> tuple[Tensor, Tensor]:
    viewmats, Ks = zip(
        *(make_camera(size, azimuth=30.0 + 360.0 * view / views) for view in range(views)),
        strict=True,
    )
    return torch.stack(viewmats).to(scene.means), torch.stack(Ks).to(scene.means)


def cotangents(size: int, views: int, scene: Scene) -> tuple[Tensor, Tensor, Tensor]:
    """Fixed gradients of image, depth and alpha."""
    noise = torch.randn(views, size, size, 5, generator=torch.Generator().manual_seed(size)) / size
    return tuple(x.contiguous() for x in noise.to(scene.means).split([3, 1, 1], -1))


def drawer(
    scene: Scene, size: int, views: int, backend: str, **options: Any
) -> Callable[[], tuple[Tensor, ...]]:
    """A function that gives image, depth, alpha and the gradients of all attributes, for a fixed
    cotangent.
    """
    from threestudio_gaussiandreamer.splatting import rasterize

    viewmats, Ks = cameras(size, views, scene)
    upstream = cotangents(size // options.get("downsample", 1), views, scene)

    def draw() -> tuple[Tensor, ...]:
        out = rasterize(*scene, viewmats, Ks, size, size, backend=backend, **options)
        pictures = (out.image, out.depth, out.alpha)
        return (
            *(x.detach() for x in pictures),
            *torch.autograd.grad(pictures, list(scene), upstream),
        )

    return draw


def correct(args: argparse.Namespace) -> dict[str, Any]:
    """Each case against plain torch in float64, and against itself."""
    cases = in_process("errors", args)
    wrong = [f"{name}: {words}" for name, case in cases.items() for words in complaints(case)]
    return {"relative_errors": cases} | ({"failed": wrong} if wrong else {})


def complaints(case: dict[str, Any]) -> Iterator[str]:
    """What rounding doesn't explain."""
    if "failed" in case:
        yield case["failed"]
        return
    if not case["same_bits"]:
        yield "a second call gives other bits"
    if not case["image"] <= IMAGE_ERROR:
        yield f"image off by {case['image']:.2e}"
    if not case["gradient"] <= GRADIENT_ERROR:
        yield f"gradient by {case['gradient']:.2e}"


def errors(args: argparse.Namespace) -> dict[str, Any]:
    cases = [
        (300, 33, 2, {}),
        (2000, 64, 2, {"antialias": True}),
        (2000, 64, 1, {"downsample": 2, "preset": "accurate"}),
    ]
    cases += [] if args.small else [(20_000, 256, 2, {}), (100_000, 512, 1, {"preset": "fast"})]
    found = {}
    for count, size, views, options in cases:
        name = " ".join(
            [
                f"{count} at {size}^2 x {views}",
                *(f"{key}={value}" for key, value in options.items()),
            ]
        )
        found[name] = guarded(
            lambda _, case=(count, size, views, options): errors_of(args, *case), args
        )
        print(name, found[name])
    return found


def errors_of(
    args: argparse.Namespace, count: int, size: int, views: int, options: dict[str, Any]
) -> dict[str, Any]:
    scene = make_scene(count)
    draw = drawer(on(args.device, scene), size, views, args.device, **options)
    once, again = draw(), draw()
    exact = drawer(on(args.device, scene, torch.float64), size, views, "torch", **options)()
    return {
        "image": max(relative(a, b) for a, b in zip(once[:3], exact[:3], strict=True)),
        "gradient": max(trimmed(a, b) for a, b in zip(once[3:], exact[3:], strict=True)),
        "same_bits": all(torch.equal(a, b) for a, b in zip(once, again, strict=True)),
    }


def relative(value: Tensor, exact: Tensor) -> float:
    return float((value.double() - exact).norm() / exact.norm())


def trimmed(value: Tensor, exact: Tensor) -> float:
    """The relative error without the worst Gaussians."""
    errors = (
        (value.double() - exact).flatten(1).norm(dim=1)
        if value.ndim > 1
        else (value.double() - exact).abs()
    )
    kept = errors.sort().values[: max(1, int((1 - TRIMMED) * len(errors)))]
    return float(kept.norm() / exact.norm())


def compile_kernels(args: argparse.Namespace) -> dict[str, Any]:
    """Seconds from the first call to its picture, in new processes: with an empty cache, and with
    what that left.
    """
    with tempfile.TemporaryDirectory() as cache:
        return {
            name: in_process("first_picture", args, {"GAUSSIANDREAMER_CACHE": cache})["seconds"]
            for name in ("first", "later")
        }


def first_picture(args: argparse.Namespace) -> dict[str, Any]:
    draw = drawer(on(args.device, make_scene(1000)), 64, 1, args.device)
    synchronize(args)
    started = time.perf_counter()
    draw()
    synchronize(args)
    return {"seconds": round(time.perf_counter() - started, 3)}


def sanitize(args: argparse.Namespace) -> dict[str, Any]:
    tool = shutil.which("compute-sanitizer") or next(
        (p for p in ["/usr/local/cuda/bin/compute-sanitizer"] if os.path.exists(p)), None
    )
    if args.device != "cuda" or tool is None:
        return {"skipped": "there is no compute-sanitizer on the path"}
    return {
        kind: guarded(lambda _, kind=kind: sanitize_with(tool, kind, args), args)
        for kind in SANITIZERS
    }


def sanitize_with(tool: str, kind: str, args: argparse.Namespace) -> dict[str, Any]:
    """What one of its tools says of a first picture; a machine where the tool can't run is no
    failure of ours.
    """
    uncached = {
        "PYTORCH_NO_CUDA_MEMORY_CACHING": "1"
    }  # torch's own allocator would hide what lies outside of a tensor
    prefix = [tool, "--tool", kind, "--error-exitcode", str(SANITIZER_FOUND), *SANITIZERS[kind]]
    with tempfile.TemporaryDirectory() as folder:
        part = part_command("first_picture", args, Path(folder) / "found.json")
        status, text = run(prefix + part, args, SECONDS["sanitize"], uncached)
    verdict = {0: "clean", SANITIZER_FOUND: "failed"}.get(status, "unavailable")
    return {verdict: text[-1500:] if status else True}


# ---- speed ---------------------------------------------------------------------------------------


def synchronize(args: argparse.Namespace) -> None:
    if args.device == "cuda":
        torch.cuda.synchronize()


def timed(args: argparse.Namespace, call: Callable[[], Any], repetitions: int) -> dict[str, float]:
    """Milliseconds of a call, its quartiles, and the most memory that it took beyond what was
    there.
    """
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
    memory = (
        {"mb": round((torch.cuda.max_memory_allocated() - before) / 2**20, 1)}
        if args.device == "cuda"
        else {}
    )
    return {"ms": middle, "q1": low, "q3": high} | memory


def bench(args: argparse.Namespace) -> dict[str, Any]:
    """Ours at every preset, and gsplat, forward with backward."""
    found = in_process("speed", args)
    if args.device != "cuda" or args.small:
        return found | {"gsplat": {"skipped": "needs a GPU"}}
    found["gsplat"] = guarded(gsplat, args)
    if "failed" in found["gsplat"]:  # a peer that doesn't build here is no failure of ours
        found["gsplat"] = {"unavailable": found["gsplat"]["failed"]}
    else:
        found["times_faster_than_gsplat"] = round(found["gsplat"]["ms"] / found["fast"]["ms"], 2)
    return found


def speed(args: argparse.Namespace) -> dict[str, Any]:
    count, size, views = (500, 32, 2) if args.small else (100_000, 1024, 4)
    scene, repetitions = on(args.device, make_scene(count)), 4 if args.small else 50
    found: dict[str, Any] = {"gaussians": count, "size": size, "views": views}
    for preset in ("fast", "balanced", "accurate"):
        found[preset] = timed(
            args, drawer(scene, size, views, args.device, preset=preset), repetitions
        )
        print(preset, found[preset])
    return found


def gsplat(args: argparse.Namespace) -> dict[str, Any]:
    """gsplat as it is installed, else of PyPI in a folder of its own; its kernels are built at
    first use, for this GPU alone.
    """
    with tempfile.TemporaryDirectory() as folder:
        if importlib.util.find_spec("gsplat") is None:
            pip = [
                sys.executable,
                "-m",
                "pip",
                "install",
                "--quiet",
                "--retries",
                "1",
                "--no-deps",
                "--target",
                folder,
            ]
            status, text = run([*pip, *GSPLAT], args, SECONDS["pip"], {})
            if status:
                raise RuntimeError(f"gsplat isn't installed and can't be: {text[-1000:]}")
        paths = {
            "PYTHONPATH": os.pathsep.join(filter(None, [os.environ.get("PYTHONPATH"), folder])),
            "PATH": os.pathsep.join(
                [f"{folder}/bin", str(Path(sys.executable).parent), os.environ.get("PATH", "")]
            ),  # ninja
            "MAX_JOBS": str(os.cpu_count()),
        }
        return in_process("gsplat_steps", args, paths)


def gsplat_steps(args: argparse.Namespace) -> dict[str, Any]:
    os.environ["TORCH_CUDA_ARCH_LIST"] = "{}.{}".format(*torch.cuda.get_device_capability())
    from gsplat import rasterization

    scene = on(args.device, make_scene(100_000))
    viewmats, Ks = cameras(1024, 4, scene)
    image, depth, alpha = cotangents(1024, 4, scene)
    upstream = torch.cat([image, depth], -1), alpha

    def step() -> None:
        pictures, alphas, _ = rasterization(
            *scene, viewmats, Ks, 1024, 1024, render_mode="RGB+D", packed=False
        )
        torch.autograd.grad((pictures, alphas), list(scene), upstream)

    return timed(args, step, 50)


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
    """Seconds per step and memory of the paper's configuration, whole and for little memory."""
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
    """A short run of the launcher itself; the first steps, which warm up, aren't counted."""
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
    """The paper's configuration from a mesh in the place of Shap-E, which has no part in a step."""
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


SECTIONS: dict[str, Callable[[argparse.Namespace], dict[str, Any]]] = {
    "compile": compile_kernels,
    "correct": correct,
    "sanitize": sanitize,
    "bench": bench,
    "prune": prune,
    "train": train,
}
PARTS: dict[str, Callable[[argparse.Namespace], dict[str, Any]]] = {
    "about": describe_device,
    "first_picture": first_picture,
    "errors": errors,
    "speed": speed,
    "gsplat_steps": gsplat_steps,
    "prune_twice": prune_twice,
    "make_model": make_model,
    "train_steps": train_steps,
}


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
