"""Data module ``gaussiandreamer-datamodule``: random training cameras, rings for the other stages.

Batch keys, units and options are those of threestudio's ``random-camera-datamodule``, under whose
name it is also registered in the built-in host, except that cameras aren't perturbed, that there
are no rays, and that the batch of step k is a function of (seed, k).

========================  ==========================================================================
option                    meaning
========================  ==========================================================================
height, width             pixels; a number, or a list with one entry more than
                          ``resolution_milestones``
batch_size                views per step, which several processes share; a number or such a list
*_range                   elevation and azimuth in degrees, distance in world units, fovy in degrees
                          (vertical)
batch_uniform_azimuth     each view of a batch in its own azimuth sector
n_view                    how many views of an object a multi-view model sees together: so many
                          consecutive views have one elevation, distance and field of view, and
                          evenly spaced azimuths; ``batch_size`` is a multiple
train_views               0: continuous cameras; n: draw from a fixed pool of n views (so that
                          targets can be reused)
========================  ==========================================================================
"""

import bisect
import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any, ClassVar, List, Optional, Tuple

import torch
from jaxtyping import Int
from torch import Tensor
from torch.utils.data import DataLoader, IterableDataset

from .. import cameras
from ..cameras import Orbit, OrbitRanges
from ..core.distributed import own_rows, world_size
from ..core.errors import UserError
from ..core.options import (
    Rule,
    count_of,
    in_range,
    interval,
    is_list,
    is_whole,
    require_memory,
    satisfies,
)
from ..core.streams import generator
from ..host import Updateable, parse_structured, pl, register, register_builtin, run_seed

MAX_SIDE = 16_384  # pixels of a picture each way
FAR = 1e6
"""Distances of cameras and lights, world units: float32 keeps places to some digits in it."""
TRAIN_BYTES, EVAL_BYTES, CAMERA_BYTES = 64, 32, 256
"""What a pixel of a training view, a pixel of an evaluated view, and a camera take at least."""
FOVY = 1e-3, 179.999, "degrees"
DISTANCE = 1e-6, FAR, "world units"
LIGHT_DISTANCES = (0.8, 1.5)  # world units
PIXELS = in_range(1, MAX_SIDE, "pixels")
Range = Tuple[float, float]


def whole_numbers(high: int) -> Rule:
    """Return the rule for whole numbers from 1 to ``high``, or lists of such."""

    def holds(value: Any) -> bool:
        values = value if is_list(value) else [value]
        return len(values) > 0 and all(is_whole(v) and 1 <= v <= high for v in values)

    return satisfies(f"whole numbers from 1 to {high}", holds)


@dataclass
class CameraConfig:
    height: Any = field(default=64, metadata=whole_numbers(MAX_SIDE))
    width: Any = field(default=64, metadata=whole_numbers(MAX_SIDE))
    batch_size: Any = field(default=1, metadata=whole_numbers(4096))
    resolution_milestones: List[int] = field(default_factory=list)
    eval_height: int = field(default=512, metadata=PIXELS)
    eval_width: int = field(default=512, metadata=PIXELS)
    n_val_views: int = field(default=1, metadata=count_of("views", 1, CAMERA_BYTES))
    n_test_views: int = field(default=120, metadata=count_of("views", 1, CAMERA_BYTES))
    elevation_range: Range = field(default=(-10, 60), metadata=interval(-90, 90, "degrees"))
    azimuth_range: Range = field(default=(-180, 180), metadata=interval(-36_000, 36_000, "degrees"))
    camera_distance_range: Range = field(default=(1.5, 4.0), metadata=interval(*DISTANCE))
    fovy_range: Range = field(default=(40, 70), metadata=interval(*FOVY))
    eval_elevation_deg: float = field(default=15.0, metadata=in_range(-90, 90, "degrees"))
    eval_camera_distance: float = field(default=4.0, metadata=in_range(*DISTANCE))
    eval_fovy_deg: float = field(default=70.0, metadata=in_range(*FOVY))
    batch_uniform_azimuth: bool = True
    train_views: int = field(default=0, metadata=count_of("views", 0, CAMERA_BYTES))
    n_view: int = field(default=1, metadata=in_range(1, 64, "views"))

    REMOVED: ClassVar[dict[str, Any]] = {
        "hold_steps": (1, "each step has its own cameras"),
        "eval_batch_size": (1, "views are evaluated one at a time"),
        "light_position_perturb": (1.0, "it is 1"),
        "light_distance_range": (
            lambda pair: is_list(pair) and tuple(pair) == LIGHT_DISTANCES,
            "it is 0.8 to 1.5",
        ),
        "rays": (False, "cameras.ray_directions(c2w, fovy, height, width) computes them"),
        "rays_d_normalize": (True, "rays have unit length"),
        "camera_perturb": (0, "cameras look at the origin from where they are drawn"),
        "center_perturb": (0, "cameras look at the origin"),
        "up_perturb": (0, "z is up"),
        "progressive_until": (0, "all steps draw from the whole ranges"),
    }

    @staticmethod
    def check(cfg: Any) -> None:
        milestones = list(cfg.resolution_milestones)
        if any(later <= earlier for earlier, later in pairwise([0, *milestones])):
            expected = "expected increasing steps above 0"
            raise UserError(f"resolution_milestones: {expected}, got {milestones}")
        counts = {}
        for name in ("height", "width", "batch_size"):
            counts[name] = len(values) if is_list(values := getattr(cfg, name)) else 1
            if counts[name] not in (1, len(milestones) + 1):
                raise UserError(
                    f"{name}: {counts[name]} entries need {counts[name] - 1} "
                    "resolution_milestones, the steps at which the next entry applies, got "
                    f"{len(milestones)}"
                )
        if milestones and not any(count > 1 for count in counts.values()):
            needed = f"{len(milestones) + 1} entries"
            raise UserError(f"resolution_milestones: give height, width or batch_size {needed}")
        if cfg.train_views and cfg.n_view > 1:
            raise UserError("train_views: a fixed pool of views has no groups: set n_view=1")
        for height, width, batch in sizes_of_stages(cfg):
            if batch % cfg.n_view:
                expected = f"expected multiples of n_view={cfg.n_view}"
                raise UserError(f"batch_size: {expected}, got {batch}")
            what = f"{batch} views of {height} x {width} pixels"
            require_memory("batch_size", TRAIN_BYTES * height * width * batch, what)
        what = f"pictures of {cfg.eval_height} x {cfg.eval_width} pixels"
        require_memory("eval_height", EVAL_BYTES * cfg.eval_height * cfg.eval_width, what)


def sizes_of_stages(cfg: Any) -> list[tuple[int, int, int]]:
    """Return height, width and number of the views in a step of each stage."""
    stages = range(len(cfg.resolution_milestones) + 1)
    sizes = [v if is_list(v) else [v] for v in (cfg.height, cfg.width, cfg.batch_size)]
    return [tuple(values[min(i, len(values) - 1)] for values in sizes) for i in stages]


def require_shareable(cfg: Any, processes: Optional[int] = None) -> None:
    """Raise UserError unless the processes, by default those that there are, can share the views of
    a step equally, of which ``n_view`` consecutive ones stay in one process.
    """
    size, together = processes or world_size(), getattr(cfg, "n_view", 1)
    for *_, views in sizes_of_stages(cfg):
        if views % (size * together):
            said = "fewer than" if views < size * together else "no multiple of"
            said += f" the {size} processes that share the views of a step"
            said += f" in groups of {together}" if together > 1 else ""
            fits = f"set data.batch_size to {size * together} or a multiple"
            fits += f", or use as many processes as divide {views // together}"
            raise UserError(f"data.batch_size is {views}, {said}: {fits}")


def orbit_batch(orbit: Orbit, height: int, width: int) -> dict[str, Any]:
    """Make the host's batch of B views, with the lights at the cameras; both sizes are ints."""
    c2w, proj = orbit.c2w, cameras.projection(orbit.fovy, width / height)
    return {
        "c2w": c2w,
        "proj_mtx": proj,
        "mvp_mtx": proj @ cameras.world_to_camera(c2w),
        "camera_positions": c2w[:, :3, 3].clone(),
        "light_positions": c2w[:, :3, 3].clone(),
        "elevation": orbit.elevation,
        "azimuth": orbit.azimuth,
        "camera_distances": orbit.distance,
        "fovy": orbit.fovy,
        "height": height,
        "width": width,
    }


def _rows(batch: dict[str, Any], index: Any) -> dict[str, Any]:
    """Select views of a batch."""
    return {k: v[index] if torch.is_tensor(v) else v for k, v in batch.items()}


class TrainCameras(IterableDataset, Updateable):
    """An endless stream of training batches, each epoch's from ``next_step()`` on."""

    def __init__(self, cfg: CameraConfig) -> None:
        self.cfg = cfg
        self.next_step: Callable[[], int] = lambda: 0
        self._pool_batches: dict[tuple[int, int], dict[str, Any]] = {}  # all views, by their size
        self.sizes = sizes_of_stages(cfg)
        require_shareable(cfg)
        ranges = cfg.elevation_range, cfg.azimuth_range, cfg.camera_distance_range, cfg.fovy_range
        self.ranges, count = OrbitRanges(*map(tuple, ranges)), cfg.train_views
        self.pool = cameras.camera_pool(count, self.ranges, run_seed()) if count else None

    def __iter__(self):
        return itertools.count(self.next_step())

    def collate(self, step: int) -> dict[str, Any]:
        """Return this process's views of the batch for ``step``, a function of (seed, step)."""
        stage = bisect.bisect_right(self.cfg.resolution_milestones, step)
        (height, width, batch_size), (low, high) = self.sizes[stage], LIGHT_DISTANCES
        rng, size = generator(run_seed(), "camera", step), (height, width)
        if self.pool:
            if size not in self._pool_batches:
                self._pool_batches[size] = orbit_batch(self.pool, *size)
            views = _rows(self._pool_batches[size], self._pick(batch_size, rng))
        else:
            views = orbit_batch(self._sample(batch_size, rng), *size)
        # point lights around the camera's direction, as in DreamFusion
        towards = views["c2w"][:, :3, 3] + torch.randn(batch_size, 3, generator=rng)
        towards /= torch.linalg.vector_norm(towards, dim=-1, keepdim=True).clamp_min(1e-12)
        distances = torch.rand(batch_size, 1, generator=rng)
        views["light_positions"] = towards * (low + (high - low) * distances)
        return _rows(views, own_rows(batch_size))

    def _sample(self, batch_size: int, rng: torch.Generator) -> Orbit:
        rest = self.ranges, rng, self.cfg.batch_uniform_azimuth
        if self.cfg.n_view == 1:
            return cameras.sample_orbit(batch_size, *rest)
        return cameras.sample_view_groups(batch_size, self.cfg.n_view, *rest)

    def _pick(self, batch_size: int, rng: torch.Generator) -> Int[Tensor, " B"]:
        """Draw views of the pool, which is ordered by azimuth, one from each sector."""
        share, views = torch.rand(batch_size, generator=rng), len(self.pool.azimuth)
        if self.cfg.batch_uniform_azimuth:
            share = (share + torch.arange(batch_size)) / batch_size
        return (share * views).long().clamp_max(views - 1)


def ring_loader(cfg: CameraConfig, count: int) -> DataLoader:
    """Load a ring of views at the evaluation elevation and distance, one per batch."""
    # without 360 degrees, which would repeat the first view in a looped video
    azimuth, same = torch.linspace(0.0, 360.0, count + 1)[:-1], torch.ones(count)
    distance, fovy = same * cfg.eval_camera_distance, same * math.radians(cfg.eval_fovy_deg)
    ring = Orbit(same * cfg.eval_elevation_deg, azimuth, distance, fovy)

    def collate(indices: list[int]) -> dict[str, Any]:
        index = torch.tensor(indices)
        return {"index": index} | orbit_batch(ring.rows(index), cfg.eval_height, cfg.eval_width)

    return DataLoader(range(count), collate_fn=collate)


@register_builtin("random-camera-datamodule")
@register("gaussiandreamer-datamodule")
class GaussianDreamerDataModule(pl.LightningDataModule):
    Config = CameraConfig

    def __init__(self, cfg: Any = None) -> None:
        super().__init__()
        self.cfg = parse_structured(self.Config, cfg, "data.")

    def setup(self, stage: str | None = None) -> None:
        if stage in (None, "fit"):
            self.train_dataset = TrainCameras(self.cfg)

    def train_dataloader(self) -> DataLoader:
        trainer, cameras = self.trainer, self.train_dataset
        if trainer is not None:  # which is at a later step in a resumed run or a later epoch
            cameras.next_step = lambda: trainer.global_step
        return DataLoader(cameras, batch_size=None, collate_fn=cameras.collate)

    def val_dataloader(self) -> DataLoader:
        return ring_loader(self.cfg, self.cfg.n_val_views)

    def test_dataloader(self) -> DataLoader:
        return ring_loader(self.cfg, self.cfg.n_test_views)

    predict_dataloader = test_dataloader
