"""What a fuzz target is, and what every target checks."""

import contextlib
import logging
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple, Optional

import numpy as np
import torch

from tests.fuzz.mutations import BINARY, Mutator, Packing
from tests.fuzz.oracles import Illegal
from threestudio_gaussiandreamer import register_parts
from threestudio_gaussiandreamer.gaussians.gaussians import Gaussians
from threestudio_gaussiandreamer.gaussians.point_cloud import PointCloud
from threestudio_gaussiandreamer.splatting import rasterize
from threestudio_gaussiandreamer.training.geometry import GaussianCloud

ROOT = Path(__file__).parents[2]
register_parts()


class Misread(Exception):
    """A damaged file was read as something that it doesn't contain."""


class Target(NamedTuple):
    """One reader, or another entry point that takes untrusted input."""

    suffix: str
    seeds: Callable[[], list[bytes]]
    exercise: Callable[[Path], None]
    mutators: list[Mutator] = BINARY
    packing: Optional[Packing] = None
    traced: bool = True
    """Whether memory is traced, which is slow; configurations count their values instead."""


def require(holds: bool, problem: str) -> None:
    if not holds:
        raise Misread(problem)


# ---- pictures ------------------------------------------------------------------------------------

EYE = torch.eye(4)[None].clone()
EYE[:, 2, 3] = 3.0
FOCAL = torch.tensor([[[12.0, 0, 6], [0, 12, 6], [0, 0, 1]]])


def require_picture(geometry: GaussianCloud) -> None:
    """Require that no pixel and no gradient of a cloud is NaN; gradients may overflow for extreme
    colours.
    """
    colors = geometry.colors(torch.tensor([[0.0, 0, -3]]))
    out = rasterize(
        geometry.means,
        geometry.quats,
        geometry.scales(),
        geometry.opacities(),
        colors,
        EYE,
        FOCAL,
        12,
        12,
    )
    require(
        bool(
            out.image.isfinite().all() and out.alpha.isfinite().all() and out.depth.isfinite().all()
        ),
        "a pixel isn't finite",
    )
    out.image.clamp(-10, 10).sum().backward()
    require(
        bool(
            torch.nan_to_num(geometry.sh0.detach()).abs().max() > 1e10
            or geometry.means.grad.isfinite().all()
        ),
        "gradient",
    )


def cloud_of(arrays: Gaussians) -> GaussianCloud:
    geometry = GaussianCloud({"sh_degree": min(int(arrays.sh.shape[1] ** 0.5) - 1, 3)})
    geometry.set_arrays(**arrays._asdict())
    return geometry


def require_points(cloud: PointCloud) -> None:
    """Require what every prior guarantees."""
    shapes = {np.shape(cloud.points), np.shape(cloud.colors), (len(cloud.points), 3)}
    require(len(shapes) == 1 and len(cloud.points) > 0, f"shapes {shapes}")
    require(
        bool(np.isfinite(cloud.points).all() and np.isfinite(cloud.colors).all()),
        "points or colours aren't finite",
    )
    require(
        bool((cloud.colors >= 0).all() and (cloud.colors <= 1).all()), "colours outside of [0, 1]"
    )
    if cloud.faces is not None and len(cloud.faces):
        require(
            0 <= cloud.faces.min() and cloud.faces.max() < len(cloud.points),
            "a face names a point that isn't there",
        )


def same(ours: np.ndarray, theirs: np.ndarray, what: str) -> None:
    """Require equal float32 bits; NaN equals NaN."""
    with np.errstate(over="ignore", invalid="ignore"):
        ours, theirs = np.asarray(ours, np.float32), np.asarray(theirs).astype(np.float32)
    require(
        ours.shape == theirs.shape and np.array_equal(ours, theirs, equal_nan=True),
        f"{what} aren't what the file says",
    )


def strictly(read: Callable[[bytes], Any], path: Path) -> Any:
    """Return what the strict reader makes of a file that the package has read."""
    try:
        return read(path.read_bytes())
    except Illegal as error:
        raise Misread(f"the file was read though it is illegal: {error}") from error


@contextlib.contextmanager
def messages() -> Iterator[list[str]]:
    """Collect what the package logs."""
    records: list[str] = []
    handler = logging.Handler()
    handler.emit = lambda record: records.append(record.getMessage())
    logger = logging.getLogger("threestudio_gaussiandreamer")
    logger.addHandler(handler)
    try:
        yield records
    finally:
        logger.removeHandler(handler)
