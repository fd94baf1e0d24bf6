"""Compare the CUDA kernels with plain torch on a GPU, once, before they are used there.

A small fixed scene is rendered and differentiated by the kernels in float32 and, at the same time,
by plain torch in float64 on the CPU: on the GPU torch's many small kernels would have to be loaded,
which takes many times longer. The result is cached beside the compiled kernels; it is computed
again for another GPU, driver, compiler, torch version or source text of the CUDA backend."""

import contextlib
import functools
import hashlib
import math
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from types import ModuleType
from typing import Optional

import torch
from torch import Tensor

from ...core.devices import torch_threads
from ...core.errors import UserError
from .. import torch_backend
from ..options import RasterizeOptions
from ..scene import Scene
from . import backend as kernels
from . import driver, nvrtc

TOLERANCE = 1e-3
"""Largest error of an output or a gradient, relative to its largest entry. Rounding gives 1e-5; a
Gaussian that falls on the other side of a threshold in float64 gives 1e-4."""
GAUSSIANS, WIDTH, HEIGHT = 150, 36, 20  # more than a batch of ``blend``; 3 x 2 tiles
CULLED = 4096
"""Gaussians behind the cameras, which the kernels get too: torch sorts up to 4096 numbers by a
kernel that larger scenes don't need, and that takes longer to load than all others together."""
ANGLES = (0.0, 0.7)  # azimuths of the two cameras, radians
HALVED = {"downsample": 2, "antialias": True}
OPTIONS = {
    "default options": RasterizeOptions(),
    "downsample and antialias": RasterizeOptions(**HALVED),
    "downsample, antialias and absgrad": RasterizeOptions(**HALVED, absgrad=True),
}
"""The options of each draw; all kernels and all their branches on options run."""
DIFFERENTIATED = ("means", "quats", "scales", "opacities", "viewmats", "colors")
LIBRARY_ERRORS = (OSError, AttributeError)  # of ctypes: no such library, or no such function in it
Results = dict[str, dict[str, Tensor]]
"""Outputs and gradients by name, of each draw."""


@functools.cache
def failure(device: torch.device) -> Optional[str]:
    """Return why the kernels must not be used on this GPU, or None if they are right.

    Raises:
        UserError, RuntimeError: the GPU has no memory left, or fails without the kernels too;
            nothing is cached.
    """
    try:
        gpu = driver.device(device).describe()
    except UserError as error:
        return str(error)
    except LIBRARY_ERRORS as error:
        return _unusable(error, "unknown GPU")
    name = f"proof-{_key(gpu)}"
    stored = nvrtc.read_cached(name)
    if stored is None:
        try:
            stored = compare(device).encode()
        except LIBRARY_ERRORS as error:
            return _unusable(error, gpu)
        nvrtc.write_cached(name, stored)
    if not stored:
        return None
    return (
        f"{stored.decode()} {_request(gpu)}; delete {nvrtc.cached_path(name)} and start again to "
        "repeat the comparison"
    )


def _unusable(error: Exception, gpu: str) -> str:
    """Return a reason that isn't cached: a library may be mended, which the key doesn't tell."""
    return (
        f"its compiler or the driver can't be used: {type(error).__name__}: {error} "
        f"{_request(gpu)}; the next start tries again"
    )


def _request(gpu: str) -> str:
    return f"[{gpu}, torch {torch.__version__}]. Please report this message"


def _key(gpu: str) -> str:
    """Return a hash of everything that the result depends on."""
    texts = [path.read_bytes() for path in sorted(nvrtc.KERNELS.glob("*.*"))]
    texts += [text.encode() for text in nvrtc.headers().values()]
    parts = [gpu.encode(), torch.__version__.encode(), *texts]
    return hashlib.sha256(b"\0".join(parts)).hexdigest()[:24]


def compare(device: torch.device) -> str:
    """Return how the kernels fail on the scene; empty if they are right.

    Raises:
        UserError, RuntimeError: memory is short, or plain torch or earlier work on the GPU fails,
            which says nothing about the kernels.
        OSError, AttributeError: a library can't be loaded, or lacks a function.
    """
    require_torch(device)
    with _default_algorithms(), torch_threads(1), ThreadPoolExecutor(1) as pool:
        expected = pool.submit(reference)
        try:
            found = drawn_on(device)
        except (UserError, RuntimeError) as error:
            if isinstance(error, torch.cuda.OutOfMemoryError) or "out of memory" in str(error):
                raise
            return f"its kernels fail on a small scene: {error}"
        errors = relative_errors(found, expected.result())
    wrong = []
    for draw, sizes in errors.items():  # "not <=", so that NaN counts as wrong
        names = [f"{name} by {size:.1e}" for name, size in sizes.items() if not size <= TOLERANCE]
        wrong += [f"with {draw}, {', '.join(names)}"] if names else []
    if not wrong:
        return ""
    return (
        f"on a small scene its kernels differ from plain torch: {'; '.join(wrong)} (rounding is "
        f"at most {TOLERANCE:.0e})"
    )


@contextlib.contextmanager
def _default_algorithms() -> Iterator[None]:
    """Let torch use its default algorithms: an operation that the deterministic ones refuse is no
    failure of the kernels. Switching them imports torch's compiler, so only if they are on.
    """
    if not torch.are_deterministic_algorithms_enabled():
        yield
        return
    warns = torch.is_deterministic_algorithms_warn_only_enabled()
    torch.use_deterministic_algorithms(False)
    try:
        yield
    finally:
        torch.use_deterministic_algorithms(True, warn_only=warns)


def require_torch(device: torch.device) -> None:
    """Let torch compute on the device, where errors that the kernels don't cause are raised."""
    torch.ones(2, device=device)
    if device.type == "cuda":
        torch.cuda.synchronize(device)


def reference() -> Results:
    """Return the outputs and gradients of plain torch in float64, on the CPU; the two draws that
    differ only in ``absgrad`` share one.
    """
    default, *_, absolute = OPTIONS.values()
    cpu = torch.device("cpu"), torch.float64
    plain, full = (_drawn(torch_backend, *cpu, options) for options in (default, absolute))
    return {draw: full if options.downsample > 1 else plain for draw, options in OPTIONS.items()}


def drawn_on(device: torch.device) -> Results:
    """Return the outputs and gradients of the kernels in float32, for each draw."""
    return {
        draw: _drawn(kernels, device, torch.float32, options) for draw, options in OPTIONS.items()
    }


def relative_errors(found: Results, expected: Results) -> dict[str, dict[str, float]]:
    """Return the relative error of each output and gradient, for each draw."""
    return {
        draw: {name: _relative(value, expected[draw][name]) for name, value in values.items()}
        for draw, values in found.items()
    }


def _relative(found: Tensor, true: Tensor) -> float:
    """Return the largest error relative to the largest entry; what only the kernels were given, the
    last Gaussians, must be zero.
    """
    difference = found.to("cpu", torch.float64, copy=True)
    difference[tuple(slice(size) for size in true.shape)] -= true
    return float(difference.abs().max() / true.abs().max())


def _drawn(
    backend: ModuleType, device: torch.device, dtype: torch.dtype, options: RasterizeOptions
) -> dict[str, Tensor]:
    """Render and differentiate the scene, a second time with one view, and wait for the results, so
    that errors of the GPU are raised here.
    """
    with torch.inference_mode(False), torch.enable_grad():
        views = 1 if options.downsample > 1 else len(ANGLES)
        scene = _scene(device, dtype, CULLED if backend is kernels else 0)
        results = _draw(backend, scene.of_views(0, views), options)
    if device.type == "cuda":
        torch.cuda.synchronize(device)
    return results


def _draw(backend: ModuleType, scene: Scene, options: RasterizeOptions) -> dict[str, Tensor]:
    """Render a scene; return the images and the gradients of a fixed weighted sum of them."""
    leaves = {name: getattr(scene, name).requires_grad_() for name in DIFFERENTIATED}
    out = backend.rasterize(scene, options)
    images = {name: getattr(out, name) for name in ("image", "alpha", "depth")}
    # no arguments of ``backward``: given gradients, torch imports all of its symbolic shapes
    sum(_weighted_sum(image) for image in images.values()).backward()
    leaves["means2d"] = out.means2d
    gradients = {f"gradient of {name}": leaf.grad for name, leaf in leaves.items()}
    if options.absgrad:
        gradients["absolute gradient of means2d"] = out.means2d.absgrad
    detached = {name: image.detach() for name, image in images.items()}
    return detached | {"contribution": out.contribution.detach()} | gradients


def _weighted_sum(image: Tensor) -> Tensor:
    """Return a sum in which each entry has another weight, computed on the CPU."""
    image = image.cpu().flatten()
    return (image * torch.linspace(-1, 1, len(image)).to(image)).sum()


def _scene(device: torch.device, dtype: torch.dtype, culled: int) -> Scene:
    """Return the scene: Gaussians of all sizes and opacities in front of two cameras, the first one
    over all tiles, and some of them again behind the cameras.
    """
    generator = torch.Generator("cpu").manual_seed(0)

    def uniform(low: float, high: float, *shape: int) -> Tensor:
        u = torch.rand(*shape, generator=generator, dtype=torch.float32, device="cpu")
        return low + (high - low) * u

    means, quats = uniform(-0.7, 0.7, GAUSSIANS, 3), uniform(-1, 1, GAUSSIANS, 4)
    scales, opacities = uniform(0.01, 0.2, GAUSSIANS, 3), uniform(0.05, 0.99, GAUSSIANS)
    scales[0], opacities[0] = 1.0, 0.3
    colors, background = uniform(0, 1, GAUSSIANS, 3), uniform(0, 1, len(ANGLES), 3)
    numbers = torch.arange(GAUSSIANS + culled, device="cpu") % GAUSSIANS
    cloud = [x[numbers] for x in (means, quats, scales, opacities, colors)]
    cloud[0][GAUSSIANS:, 2] -= 20
    *attributes, colors, background = (x.to(device, dtype) for x in (*cloud, background))
    viewmats = torch.tensor([_viewmat(angle) for angle in ANGLES], device=device, dtype=dtype)
    focal = [[WIDTH, 0.0, WIDTH / 2], [0.0, WIDTH, HEIGHT / 2], [0.0, 0.0, 1.0]]
    Ks = torch.tensor([focal] * len(ANGLES), device=device, dtype=dtype)
    return Scene(*attributes, viewmats, colors, background, Ks, WIDTH, HEIGHT)


def _viewmat(angle: float) -> list[list[float]]:
    cos, sin = math.cos(angle), math.sin(angle)
    return [[cos, 0.0, sin, 0.0], [0.0, 1.0, 0.0, 0.0], [-sin, 0.0, cos, 3.0], [0.0, 0.0, 0.0, 1.0]]
