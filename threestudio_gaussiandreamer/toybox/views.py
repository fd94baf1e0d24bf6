"""Pictures of the toybox's objects, in shards on disk that are functions of (seed, shard): several
views of each object, which are composited over backgrounds when a shard is read, and points on it.
"""

import math
import re
import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import ClassVar, NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int, UInt8

from ..cameras import Orbit, orbit_c2w, to_opencv
from ..core.files import atomic_file
from ..core.streams import numpy_generator
from ..meshes.mesh import Mesh, sample_surface, surface_colors
from ..meshes.raycast import MeshCaster
from ..splatting import rasterize
from . import motions, world
from .kinds import KINDS
from .world import COLORS, Attributes

SIZE = 128
"""Height and width of the pictures, pixels."""
FOVY_DEG = 45.0
DISTANCE = (2.1, 2.4)
"""Range of camera distances, world units: the bounding sphere is always completely visible."""
ELEVATION, OVERHEAD_ELEVATION, OVERHEAD_SHARE = (-10.0, 60.0), (60.0, 80.0), 0.06
"""Elevations in degrees: the paper's range, and that of a share of views from above."""
BACKGROUND = (0.5, 0.5, 0.5)
"""Background of nearly all pictures; no object has this colour."""
OBJECTS, VIEWS, POINTS, HELD_OUT_OBJECTS = 256, 4, 1024, 64
"""Objects per shard, views and points per object, and objects for evaluation, all withheld ones."""

LABELS: dict[str, tuple[str, ...]] = {
    "kind": (*KINDS, world.PERSON),
    "color": tuple(COLORS),
    "pattern": world.PATTERNS,
    "second": (*COLORS, "none"),
    "part": (*COLORS, "none"),
    "accessory": (*world.THINGS_WORN, "none", "cape"),
    "accessory_color": (*COLORS, "none"),
    "action": ("none", *motions.names()),
    "quadrant": ("front", "left", "back", "right"),
}
"""The classes of what classifiers recognise: :class:`Attributes`, and the side that is shown."""


class Shard(NamedTuple):
    """N = objects x views pictures; the views of an object are adjacent."""

    rgba: UInt8[np.ndarray, "N 128 128 4"]
    """Premultiplied colour and coverage."""
    labels: Int[np.ndarray, "N L"]
    """Classes in the order of LABELS."""
    elevation: Float[np.ndarray, " N"]
    azimuth: Float[np.ndarray, " N"]
    """Azimuth of the camera, degrees."""
    points: Float[np.ndarray, "O P 6"]
    """Points uniform over each surface, float16: world positions, and colours in [0, 1]."""


@dataclass(frozen=True)
class Shards:
    """The shards of one seed, rendered on first use."""

    folder: Path
    """Contains the files, 70 MB each."""
    seed: int
    held_out: bool = False
    """Whether the objects are those withheld from training."""
    objects: int = OBJECTS
    """Of a shard."""
    views: int = VIEWS
    """Of an object."""
    file_names: ClassVar[tuple[str, str]] = "train", "held-out"
    """How the names of the files begin, of objects for training and of withheld ones."""

    def path(self, index: int) -> Path:
        """Return the file of shard ``index``."""
        sort, size = self.file_names[self.held_out], f"{self.objects}x{self.views}"
        return self.folder / f"{sort}-world{world.VERSION}-{self.seed}-{size}-{index:05d}.npz"

    def ensure(self, index: int) -> None:
        """Render shard ``index`` into its file, unless that exists."""
        path = self.path(index)
        if not path.is_file():
            self.folder.mkdir(parents=True, exist_ok=True)
            for left in self.folder.glob(f".{path.name}.*.tmp"):  # of a training that was killed
                with suppress(OSError):
                    if time.time() - left.stat().st_mtime > 3600:
                        left.unlink()
            shard = self.make(index)
            with atomic_file(path) as file:
                np.savez(file, **shard._asdict())

    @lru_cache(maxsize=4)  # noqa: B019
    def get(self, index: int) -> Shard:
        """Return shard ``index``."""
        self.ensure(index)
        with np.load(self.path(index), allow_pickle=False) as file:
            return Shard(**file)

    def held_out_shard(self) -> Shard:
        """Return the shard of withheld objects for evaluation."""
        return replace(self, held_out=True, objects=HELD_OUT_OBJECTS).get(0)

    def make(self, index: int) -> Shard:
        """Render shard ``index``."""
        rows = (self._object(index * self.objects + i) for i in range(self.objects))
        return Shard(*map(np.concatenate, zip(*rows, strict=True)))

    def _object(self, index: int) -> Shard:
        attributes = world.draw_attributes(self.seed, index, held_out=self.held_out)
        rng = numpy_generator(self.seed, "toybox-object", int(self.held_out), index)
        mesh = world.object_mesh(attributes, rng)
        orbit = draw_orbit(self.views, rng)
        rgba = (self.pictures(mesh, orbit, rng) * 255).round().astype(np.uint8)
        labels = np.stack([label_row(attributes, float(a)) for a in orbit.azimuth])
        points = surface_points(mesh, rng)[None]
        return Shard(rgba, labels, orbit.elevation.numpy(), orbit.azimuth.numpy(), points)

    def pictures(
        self, mesh: Mesh, orbit: Orbit, rng: np.random.Generator
    ) -> Float[np.ndarray, "N s s 4"]:
        """Draw these views of an object; return premultiplied RGBA in [0, 1]."""
        return render(mesh, orbit)


def draw_orbit(count: int, rng: np.random.Generator) -> Orbit:
    """Draw ``count`` views, one in each of as many azimuth sectors, the first of them random."""
    start = rng.uniform(0, 360)
    azimuth = start + 360 / count * (np.arange(count) + rng.uniform(0, 1, count))
    overhead = rng.uniform(size=count) < OVERHEAD_SHARE
    above, others = (rng.uniform(*bounds, count) for bounds in (OVERHEAD_ELEVATION, ELEVATION))
    elevation, azimuth = np.where(overhead, above, others), azimuth % 360 - 180
    fovy = np.full(count, math.radians(FOVY_DEG))
    values = (elevation, azimuth, rng.uniform(*DISTANCE, count), fovy)
    return Orbit(*(torch.from_numpy(np.float32(value)) for value in values))


def render(mesh: Mesh, orbit: Orbit, size: int = SIZE) -> Float[np.ndarray, "N s s 4"]:
    """Ray cast the mesh from these cameras; return premultiplied RGBA in [0, 1]."""
    cameras = zip(orbit_c2w(*orbit[:3]).numpy(), orbit.fovy.tolist(), strict=True)
    return MeshCaster(mesh).render_views(cameras, size, size)


def surface_points(mesh: Mesh, rng: np.random.Generator) -> Float[np.ndarray, "P 6"]:
    """Sample POINTS points with colours uniformly on the surface, float16."""
    places, faces, barycentric = sample_surface(mesh, POINTS, rng)
    colors = surface_colors(mesh, faces, barycentric)
    return np.concatenate([places, colors], axis=1).astype(np.float16)


def label_row(attributes: Attributes, azimuth: float) -> Int[np.ndarray, " L"]:
    """Return the classes of an object seen from an azimuth in degrees, in the order of LABELS."""
    quadrant = LABELS["quadrant"][int(((azimuth + 45) % 360) // 90)]
    values = attributes._asdict() | {"quadrant": quadrant}
    return np.array([classes.index(values[name] or "none") for name, classes in LABELS.items()])


def exchanged(name: str) -> Int[torch.Tensor, " C"]:
    """Return for each class of an attribute the one with left and right exchanged."""
    other, classes = {"left": "right", "right": "left"}, LABELS[name]
    names = [re.sub("left|right", lambda side: other[side[0]], each) for each in classes]
    return torch.tensor([classes.index(each) for each in names])


def attributes_of(row: Int[np.ndarray, " L"]) -> Attributes:
    """Invert :func:`label_row`."""
    values = [classes[int(i)] for classes, i in zip(LABELS.values(), row, strict=True)]
    return Attributes(*(None if value == "none" else value for value in values[:-1]))


def with_backgrounds(
    rgba: UInt8[np.ndarray, "N H W 4"], rng: np.random.Generator, *, random_share: float
) -> Float[torch.Tensor, "N 3 H W"]:
    """Return pictures in [0, 1] over BACKGROUND, or a share over random colours or gradients."""
    count, height = rgba.shape[:2]
    top, bottom = (rng.uniform(0, 1, (count, 3, 1, 1)) for _ in range(2))
    bottom = np.where(rng.uniform(size=(count, 1, 1, 1)) < 0.5, top, bottom)
    ramp = np.linspace(0, 1, height)[:, None]
    fixed, grey = rng.uniform(size=(count, 1, 1, 1)) >= random_share, np.array(BACKGROUND)
    ramp = top + (bottom - top) * ramp
    background = np.where(fixed, grey[:, None, None], ramp).astype(np.float32)
    # with the channels in front, the arithmetic runs along whole rows of pixels
    channels = torch.from_numpy(rgba.transpose(0, 3, 1, 2)).float().contiguous().div_(255)
    return channels[:, :3] + (1 - channels[:, 3:]) * torch.from_numpy(background)


def render_gaussians(
    gaussians: Sequence[np.ndarray], orbit: Orbit, *, eps2d: float
) -> Float[np.ndarray, "N s s 4"]:
    """Return premultiplied RGBA in [0, 1] of Gaussians, the first arguments of ``rasterize``."""
    viewmats, Ks = to_opencv(orbit.c2w, orbit.fovy, SIZE, SIZE)
    gaussians = [torch.from_numpy(np.float32(values)) for values in gaussians]
    drawn = rasterize(*gaussians, viewmats, Ks, SIZE, SIZE, preset="fast", eps2d=eps2d)
    alpha = drawn.alpha.reshape(*drawn.image.shape[:-1], 1)
    return torch.cat([drawn.image, alpha], dim=-1).clamp(0, 1).numpy()
