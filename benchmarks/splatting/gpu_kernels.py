"""The kernels' sections of ``gpu_check``: correctness against plain torch in float64, time of the
first render, compute-sanitizer, and speed beside gsplat.
"""

import argparse
import importlib.util
import os
import shutil
import statistics
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Optional

import torch
from torch import Tensor

from benchmarks.splatting.bench_scenes import Scene, make_camera, make_scene
from benchmarks.splatting.gpu_processes import SECONDS, guarded, in_process, part_command, run

TRIMMED = 0.005
"""The share of Gaussians, those with the worst gradients, that is left out: a rounding turns a
pixel's alpha over the cut.
"""
GRADIENT_ERROR, IMAGE_ERROR = 2e-5, 1e-4
COMPARISON_AIM = 0.1
"""Seconds that the comparison at the first use should take at most."""
GSPLAT = ("gsplat", "ninja", "rich", "jaxtyping", "markdown-it-py", "mdurl", "pygments")
"""It and what it needs; without pip's own search for dependencies, which would fetch another torch.
"""
SANITIZERS = {
    # torch asks for functions that a driver may not have
    "memcheck": ("--report-api-errors", "no"),
    "racecheck": (),
}
SANITIZER_FOUND = 99


# ---- correctness ---------------------------------------------------------------------------------


def on(device: str, scene: Scene, dtype: torch.dtype = torch.float32) -> Scene:
    """Return the scene as leaves of a graph."""
    return Scene(*(x.detach().to(device, dtype).requires_grad_() for x in scene))


def cameras(size: int, views: int, scene: Scene) -> tuple[Tensor, Tensor]:
    viewmats, Ks = zip(
        *(make_camera(size, azimuth=30.0 + 360.0 * view / views) for view in range(views)),
        strict=True,
    )
    return torch.stack(viewmats).to(scene.means), torch.stack(Ks).to(scene.means)


def cotangents(size: int, views: int, scene: Scene) -> tuple[Tensor, Tensor, Tensor]:
    """Return fixed gradients of image, depth and alpha."""
    noise = torch.randn(views, size, size, 5, generator=torch.Generator().manual_seed(size)) / size
    return tuple(x.contiguous() for x in noise.to(scene.means).split([3, 1, 1], -1))


def drawer(
    scene: Scene,
    size: int,
    views: int,
    backend: str,
    background: Optional[Tensor] = None,
    **options: Any,
) -> Callable[[], tuple[Tensor, ...]]:
    """Return a function that computes image, depth, alpha and the gradients of all attributes, and
    of the background if there is one, for a fixed cotangent.
    """
    from threestudio_gaussiandreamer.splatting import rasterize

    viewmats, Ks = cameras(size, views, scene)
    upstream = cotangents(size // options.get("downsample", 1), views, scene)
    leaves = [*scene] if background is None else [*scene, background]
    options |= {"background": background, "backend": backend}

    def draw() -> tuple[Tensor, ...]:
        out = rasterize(*scene, viewmats, Ks, size, size, **options)
        pictures = (out.image, out.depth, out.alpha)
        return (
            *(x.detach() for x in pictures),
            *torch.autograd.grad(pictures, leaves, upstream),
        )

    return draw


def correct(args: argparse.Namespace) -> dict[str, Any]:
    """Compare each case, and one of the fallback, with plain torch in float64."""
    cases = in_process("errors", args)
    slow = guarded(lambda _: in_process("fallback", args), args)
    checked = cases | {"plain torch in float32": slow}
    wrong = [f"{name}: {words}" for name, case in checked.items() for words in complaints(case)]
    return {"relative_errors": cases, "fallback": slow} | ({"failed": wrong} if wrong else {})


def complaints(case: dict[str, Any]) -> Iterator[str]:
    """Return differences that rounding does not explain."""
    if "failed" in case:
        yield case["failed"]
        return
    if not case.get("same_bits", True):
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


def fallback(args: argparse.Namespace) -> dict[str, float]:
    """Return the errors of plain torch in float32, which draws where the kernels can't run; on a
    GPU a second call may give other bits.
    """
    found = errors_of(args, 2000, 64, 2, {"downsample": 2, "antialias": True}, "torch")
    return {name: found[name] for name in ("image", "gradient")}


def errors_of(
    args: argparse.Namespace,
    count: int,
    size: int,
    views: int,
    options: dict[str, Any],
    backend: str = "",
) -> dict[str, Any]:
    """Compare a backend, by default the device's kernels, with plain torch in float64, and with
    itself.
    """
    scene = make_scene(count)

    def drawn(dtype: torch.dtype, name: str) -> Callable[[], tuple[Tensor, ...]]:
        background = torch.linspace(0, 1, 3 * views).view(views, 3).to(args.device, dtype)
        inputs = on(args.device, scene, dtype)
        return drawer(inputs, size, views, name, background.requires_grad_(), **options)

    draw = drawn(torch.float32, backend or args.device)
    once, again, exact = draw(), draw(), drawn(torch.float64, "torch")()
    attributes = zip(once[3:-1], exact[3:-1], strict=True)
    return {
        "image": max(relative(a, b) for a, b in zip(once[:3], exact[:3], strict=True)),
        "gradient": max(relative(once[-1], exact[-1]), *(trimmed(a, b) for a, b in attributes)),
        "same_bits": all(torch.equal(a, b) for a, b in zip(once, again, strict=True)),
    }


def relative(value: Tensor, exact: Tensor) -> float:
    return float((value.double() - exact).norm() / exact.norm())


def trimmed(value: Tensor, exact: Tensor) -> float:
    """Return the relative error without the worst Gaussians."""
    errors = (
        (value.double() - exact).flatten(1).norm(dim=1)
        if value.ndim > 1
        else (value.double() - exact).abs()
    )
    kept = errors.sort().values[: max(1, int((1 - TRIMMED) * len(errors)))]
    return float(kept.norm() / exact.norm())


def compile_kernels(args: argparse.Namespace) -> dict[str, Any]:
    """Return the seconds from the first call to its image, in new processes: with an empty cache,
    with a filled one, and with one that lacks the verdict of the comparison that precedes the
    first use; and those of the comparison itself.
    """
    with tempfile.TemporaryDirectory() as cache:
        environment = {"GAUSSIANDREAMER_CACHE": cache}
        first, later = (in_process("first_picture", args, environment) for _ in range(2))
        for verdict in Path(cache).glob("proof-*"):
            verdict.unlink()
        again = in_process("first_picture", args, environment)
        compared = in_process("comparison", args, environment)
    seconds = {"first": first["seconds"], "later": later["seconds"], "compared": again["seconds"]}
    return seconds | {"comparison": compared}


def comparison(args: argparse.Namespace) -> dict[str, Any]:
    """Return the seconds of the first comparison of a process, whose kernels are compiled but not
    loaded; torch's own are among them. Says if that is longer than the aim.
    """
    from threestudio_gaussiandreamer.splatting.cuda import proof

    if args.device != "cuda":
        return {"skipped": "needs a GPU"}
    torch.zeros(1, device=args.device)  # initialises the GPU, which takes seconds
    synchronize(args)
    started = time.perf_counter()
    verdict = proof.compare(torch.device("cuda", 0))
    seconds = round(time.perf_counter() - started, 3)
    found = {"seconds": seconds, "draws": len(proof.OPTIONS)} | beyond_aim(seconds)
    return found | ({"failed": verdict} if verdict else {})


def beyond_aim(seconds: float) -> dict[str, str]:
    """Return by how much a comparison misses its aim, as "26 %"; empty if it doesn't."""
    excess = seconds / COMPARISON_AIM - 1
    return {"beyond_aim": f"{100 * excess:.0f} %"} if excess > 0 else {}


def first_picture(args: argparse.Namespace) -> dict[str, Any]:
    draw = drawer(on(args.device, make_scene(1000)), 64, 1, args.device)
    zero = torch.zeros(1, requires_grad=True)  # given gradients, torch imports symbolic shapes
    torch.autograd.grad(2 * zero, zero, torch.ones(1))
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
    """Run one tool of compute-sanitizer on a first render; a tool that cannot run here is not a
    failure.
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
    """Return milliseconds of a call, its quartiles, and its peak additional memory."""
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
    """Time this package at every preset, and gsplat, forward with backward."""
    found = in_process("speed", args)
    if args.device != "cuda" or args.small:
        return found | {"gsplat": {"skipped": "needs a GPU"}}
    found["gsplat"] = guarded(gsplat, args)
    if (
        "failed" in found["gsplat"]
    ):  # gsplat may not build here, which isn't a failure of this package
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
    large = on(args.device, make_scene(2 * count if args.small else 1_000_000))
    found["large"] = {"gaussians": len(large.means), "views": 1} | timed(
        args, drawer(large, size, 1, args.device), repetitions // 2
    )
    return found


def gsplat(args: argparse.Namespace) -> dict[str, Any]:
    """Import the installed gsplat, or install it from PyPI into a folder; its kernels are compiled
    on first use, for this GPU only.
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
