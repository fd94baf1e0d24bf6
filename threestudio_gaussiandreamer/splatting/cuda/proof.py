"""Compare the CUDA kernels with plain torch on a GPU, once, before they are used there.

A small fixed scene is rendered and differentiated by the kernels in float32 and, at the same time,
by plain torch in float64 on the CPU: on the GPU torch's many small kernels would have to be loaded,
which takes many times longer. The result is cached beside the compiled kernels; it is computed
again for another GPU, driver, compiler, torch version or source text of the CUDA backend."""

import functools
import hashlib
import math
from concurrent.futures import ThreadPoolExecutor
from types import ModuleType
from typing import Optional

import torch
from torch import Tensor

from ...core.devices import torch_threads
from ...core.errors import UserError
from .. import torch_backend
from ..scene import RasterizeOptions, Scene
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
Results = dict[str, dict[str, Tensor]]
"""Outputs and gradients by name, of each draw."""


@functools.cache
def failure(device: torch.device) -> Optional[str]:
    """Return why the kernels must not be used on this GPU, or None if they are right.

    Raises:
        UserError, RuntimeError: the GPU has no memory left, or fails without the kernels too;
            nothing is cached.
    """
    request = f"[unknown GPU, torch {torch.__version__}]. Please report this message"
    try:
        try:
            gpu = driver.device(device).describe()
        except UserError as error:  # another GPU than `unavailable` looked at, and an older one
            return str(error)
        request = request.replace("unknown GPU", gpu)
        # everything that the result depends on
        texts = [f"{gpu}\0{torch.__version__}\0".encode()]
        for folder in (nvrtc.KERNELS, nvrtc.SHARED):
            texts += [path.read_bytes() for path in sorted(folder.glob("*.*"))]
        name = f"proof-{hashlib.sha256(b''.join(texts)).hexdigest()[:24]}"
        stored = nvrtc.read_cached(name)
        if stored is None:
            stored = compare(device).encode()
            nvrtc.write_cached(name, stored)
    except (OSError, AttributeError) as error:  # of ctypes: no such library, or function in it
        # not cached: a library may be mended, which the key doesn't tell
        found = f"{type(error).__name__}: {error} {request}; the next start tries again"
        return f"its compiler or the driver can't be used: {found}"
    if not stored:
        return None
    path = nvrtc.cache_folder() / name
    return f"{stored.decode()} {request}; delete {path} and start again to repeat the comparison"


def compare(device: torch.device) -> str:
    """Return how the kernels fail on the scene; empty if they are right.

    Raises:
        UserError, RuntimeError: memory is short, or plain torch or earlier work on the GPU fails,
            which says nothing about the kernels.
        OSError, AttributeError: a library can't be loaded, or lacks a function.
    """
    # errors that the kernels don't cause are raised here
    torch.ones(2, device=device)
    if device.type == "cuda":
        torch.cuda.synchronize(device)
    # what deterministic algorithms refuse is no failure of the kernels; switching them imports
    # torch's compiler
    strict = torch.are_deterministic_algorithms_enabled()
    warns = torch.is_deterministic_algorithms_warn_only_enabled()
    if strict:
        torch.use_deterministic_algorithms(False)
    try:
        with torch_threads(1), ThreadPoolExecutor(1) as pool:
            expected = pool.submit(drawn, torch_backend, torch.device("cpu"), torch.float64)
            try:
                found = drawn(kernels, device, torch.float32)
            except (UserError, RuntimeError) as error:
                if isinstance(error, torch.cuda.OutOfMemoryError) or "out of memory" in str(error):
                    raise
                return f"its kernels fail on a small scene: {error}"
            errors = relative_errors(found, expected.result())
    finally:
        if strict:
            torch.use_deterministic_algorithms(True, warn_only=warns)
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


def drawn(backend: ModuleType, device: torch.device, dtype: torch.dtype) -> Results:
    """Return the outputs and gradients of a backend for each draw; plain torch's of the second draw
    are those of the last, which differs in ``absgrad`` only.
    """
    first, second, last = OPTIONS
    names = OPTIONS if backend is kernels else (first, last)
    found = {draw: _drawn(backend, device, dtype, OPTIONS[draw]) for draw in names}
    return found | {second: found.get(second, found[last])}


def relative_errors(found: Results, expected: Results) -> dict[str, dict[str, float]]:
    """Return the largest error of each output and gradient, relative to the largest entry, for each
    draw; what only the kernels were given, the last Gaussians, must be zero.
    """

    def error(value: Tensor, true: Tensor) -> float:
        difference = value.to("cpu", torch.float64, copy=True)
        difference[tuple(slice(size) for size in true.shape)] -= true
        return float(difference.abs().max() / true.abs().max())

    return {
        draw: {name: error(value, expected[draw][name]) for name, value in values.items()}
        for draw, values in found.items()
    }


def _drawn(
    backend: ModuleType, device: torch.device, dtype: torch.dtype, options: RasterizeOptions
) -> dict[str, Tensor]:
    """Render the scene, with options of downsampling its first view, differentiate a fixed weighted
    sum of the images, and wait for the results, so that errors of the GPU are raised here.
    """
    with torch.inference_mode(False), torch.enable_grad():
        views = 1 if options.downsample > 1 else len(ANGLES)
        scene = _scene(device, dtype, CULLED if backend is kernels else 0).of_views(0, views)
        leaves = {name: getattr(scene, name).requires_grad_() for name in DIFFERENTIATED}
        out = backend.rasterize(scene, options)
        found = {name: getattr(out, name) for name in ("image", "alpha", "depth")}
        # no arguments of ``backward``: given gradients, torch imports all of its symbolic shapes
        sum(map(_weighted_sum, found.values())).backward()
    found |= {"contribution": out.contribution}
    leaves["means2d"] = out.means2d
    found |= {f"gradient of {name}": leaf.grad for name, leaf in leaves.items()}
    if options.absgrad:
        found["absolute gradient of means2d"] = out.means2d.absgrad
    if device.type == "cuda":
        torch.cuda.synchronize(device)
    return {name: value.detach() for name, value in found.items()}


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
    turns = ((math.cos(angle), math.sin(angle)) for angle in ANGLES)
    viewmats = torch.tensor(
        [[[c, 0, s, 0], [0, 1, 0, 0], [-s, 0, c, 3.0], [0, 0, 0, 1]] for c, s in turns]
    )
    focal = [[WIDTH, 0.0, WIDTH / 2], [0.0, WIDTH, HEIGHT / 2], [0.0, 0.0, 1.0]]
    Ks = torch.tensor([focal] * len(ANGLES))
    tensors = (*cloud, viewmats, background, Ks)
    *attributes, colors, viewmats, background, Ks = (x.to(device, dtype) for x in tensors)
    return Scene(*attributes, viewmats, colors, background, Ks, WIDTH, HEIGHT)
