"""Data module ``gaussiandreamer-datamodule``: random training cameras, a ring of validation and
test cameras.

Batch keys, units and options are those of threestudio's ``random-camera-datamodule``, under whose
name it is also registered in the built-in host, except that rays are computed only with
``rays: true``, that a batch is a function of (seed, step), so that a resumed run has the same
cameras, and that step k is trained with the batch of step k: none is prefetched.

========================  ==========================================================================
option                    meaning
========================  ==========================================================================
height, width             pixels; a number, or a list with one entry more than
                          ``resolution_milestones``
batch_size                views per step, which several processes share; a number or such a list
*_range                   elevation and azimuth in degrees, distance in world units, fovy in degrees
                          (vertical)
batch_uniform_azimuth     each view of a batch in its own azimuth sector
camera_perturb            uniform shift of the camera, +- world units; center_perturb, up_perturb:
                          normal, standard deviation
progressive_until         widen the angles from the evaluation view to the full range over that many
                          steps
n_view                    how many views of an object a multi-view model sees together: so many
                          consecutive views have one elevation, distance and field of view, and
                          evenly spaced azimuths; ``batch_size`` is a multiple
train_views               0: continuous cameras; n: draw from a fixed pool of n views (so that
                          targets can be reused)
rays                      add rays_o and rays_d (B, H, W, 3) to every batch
========================  ==========================================================================
"""

import bisect
import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any, ClassVar, List, Tuple

import torch
from jaxtyping import Int
from torch import Tensor
from torch.utils.data import DataLoader, Dataset, IterableDataset

from .. import cameras
from ..cameras import Orbit, OrbitRanges
from ..core.distributed import own_rows, require_shareable
from ..core.errors import UserError
from ..core.memory import count_of, require_memory
from ..core.options import Rule, at_least, in_range, interval, is_list, is_whole, satisfies
from ..core.streams import generator
from ..host import Updateable, parse_structured, pl, register, register_builtin, run_seed

MAX_SIDE = 16_384
"""Pixels of a picture each way."""
FAR = 1e6
"""Distances of cameras and lights, world units: float32 keeps places to some digits in it."""
TRAIN_BYTES, EVAL_BYTES, CAMERA_BYTES = 64, 32, 256
"""What a pixel of a training view, a pixel of an evaluated view, and a camera take at least."""
FOVY = 1e-3, 179.999, "degrees"
DISTANCE = 1e-6, FAR, "world units"
LENGTH = in_range(0, FAR, "world units")
LIGHT_DISTANCES = (0.8, 1.5)
"""World units."""
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
    camera_perturb: float = field(default=0.0, metadata=LENGTH)
    center_perturb: float = field(default=0.0, metadata=LENGTH)
    up_perturb: float = field(default=0.0, metadata=LENGTH)
    eval_elevation_deg: float = field(default=15.0, metadata=in_range(-90, 90, "degrees"))
    eval_camera_distance: float = field(default=4.0, metadata=in_range(*DISTANCE))
    eval_fovy_deg: float = field(default=70.0, metadata=in_range(*FOVY))
    batch_uniform_azimuth: bool = True
    progressive_until: int = field(default=0, metadata=at_least(0, "steps"))
    train_views: int = field(default=0, metadata=count_of("views", 0, CAMERA_BYTES))
    rays: bool = False
    n_view: int = field(default=1, metadata=in_range(1, 64, "views"))

    REMOVED: ClassVar[dict[str, Any]] = {
        "hold_steps": (1, "each step has its own cameras"),
        "eval_batch_size": (1, "views are evaluated one at a time"),
        "light_position_perturb": (1.0, "it is 1"),
        "light_distance_range": (
            lambda pair: is_list(pair) and tuple(pair) == LIGHT_DISTANCES,
            "it is 0.8 to 1.5",
        ),
        "rays_d_normalize": (True, "rays have unit length"),
    }

    @staticmethod
    def check(cfg: Any) -> None:
        milestones, listed = list(cfg.resolution_milestones), False
        if any(later <= earlier for earlier, later in pairwise([0, *milestones])):
            raise UserError(
                f"resolution_milestones: expected increasing steps above 0, got {milestones}"
            )
        for name in ("height", "width", "batch_size"):
            count = len(values) if is_list(values := getattr(cfg, name)) else 1
            listed |= count > 1
            if count not in (1, len(milestones) + 1):
                raise UserError(
                    f"{name}: {count} entries need {count - 1} resolution_milestones, the steps at "
                    f"which the next entry applies, got {len(milestones)}"
                )
        if milestones and not listed:
            needed = f"{len(milestones) + 1} entries"
            raise UserError(f"resolution_milestones: give height, width or batch_size {needed}")
        if cfg.train_views and cfg.n_view > 1:
            raise UserError("train_views: a fixed pool of views has no groups: set n_view=1")
        if cfg.train_views and cfg.progressive_until:
            raise UserError("progressive_until: the angles of a fixed pool of views don't widen")
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


def make_batch(
    orbit: Orbit,
    c2w: Tensor,
    light_positions: Tensor,
    height: int,
    width: int,
    rays: bool = False,
) -> dict[str, Any]:
    """Make the host's batch of B views; ``height`` and ``width`` are plain ints."""
    proj = cameras.projection(orbit.fovy, width / height)
    batch = {
        "c2w": c2w,
        "proj_mtx": proj,
        "mvp_mtx": proj @ cameras.world_to_camera(c2w),
        "camera_positions": c2w[:, :3, 3].clone(),
        "light_positions": light_positions,
        "elevation": orbit.elevation,
        "azimuth": orbit.azimuth,
        "camera_distances": orbit.distance,
        "fovy": orbit.fovy,
        "height": height,
        "width": width,
    }
    if rays:
        batch["rays_d"] = cameras.ray_directions(c2w, orbit.fovy, height, width)
        batch["rays_o"] = c2w[:, None, None, :3, 3].expand_as(batch["rays_d"]).clone()
    return batch


def orbit_batch(orbit: Orbit, height: int, width: int, rays: bool = False) -> dict[str, Any]:
    """Make the host's batch of the views of ``orbit``, with the lights at the cameras."""
    c2w = orbit.c2w
    return make_batch(orbit, c2w, c2w[:, :3, 3].clone(), height, width, rays)


class TrainCameras(IterableDataset, Updateable):
    """An endless stream of training batches, each epoch's from ``next_step()`` on."""

    def __init__(self, cfg: CameraConfig) -> None:
        self.cfg = cfg
        self.next_step: Callable[[], int] = lambda: 0
        self._pool_batches: dict[tuple[int, int], dict[str, Any]] = {}  # all views, by their size
        self.sizes = sizes_of_stages(cfg)
        for _, _, batch_size in self.sizes:
            require_shareable(batch_size, "data.batch_size", together=cfg.n_view)
        ranges = cfg.elevation_range, cfg.azimuth_range, cfg.camera_distance_range, cfg.fovy_range
        self.ranges, count = OrbitRanges(*map(tuple, ranges)), cfg.train_views
        self.pool = cameras.camera_pool(count, self.ranges, run_seed()) if count else None
        self.moves = bool(cfg.camera_perturb or cfg.center_perturb or cfg.up_perturb)

    def __iter__(self):
        return itertools.count(self.next_step())

    def collate(self, step: int) -> dict[str, Any]:
        """Return this process's views of the batch for ``step``, a function of (seed, step)."""
        stage = bisect.bisect_right(self.cfg.resolution_milestones, step)
        height, width, batch_size = self.sizes[stage]
        rng, rows = generator(run_seed(), "camera", step), own_rows(batch_size)
        if self.pool:
            index = self._pick(batch_size, rng)
            if not (self.moves or self.cfg.rays):
                if (size := (height, width)) not in self._pool_batches:
                    self._pool_batches[size] = orbit_batch(self.pool, *size)
                views = self._pool_batches[size]
                lights = self._lights(views["c2w"][index], rng)[rows]
                batch = {k: v[index[rows]] if torch.is_tensor(v) else v for k, v in views.items()}
                return batch | {"light_positions": lights}
            orbit = self.pool.rows(index)
        else:
            orbit = self._sample(batch_size, self._ranges(step), rng)
        c2w = self._perturbed(orbit, rng)
        lights = self._lights(c2w, rng)
        own = orbit.rows(rows), c2w[rows], lights[rows]
        return make_batch(*own, height, width, self.cfg.rays)

    def _sample(self, batch_size: int, ranges: OrbitRanges, rng: torch.Generator) -> Orbit:
        uniform = self.cfg.batch_uniform_azimuth
        if self.cfg.n_view == 1:
            return cameras.sample_orbit(batch_size, ranges, rng, uniform)
        return cameras.sample_view_groups(batch_size, self.cfg.n_view, ranges, rng, uniform)

    def _pick(self, batch_size: int, rng: torch.Generator) -> Int[Tensor, " B"]:
        """Draw views of the pool, which is ordered by azimuth, one from each sector."""
        share, views = torch.rand(batch_size, generator=rng), len(self.pool.azimuth)
        if self.cfg.batch_uniform_azimuth:
            share = (share + torch.arange(batch_size)) / batch_size
        return (share * views).long().clamp_max(views - 1)

    def _ranges(self, step: int) -> OrbitRanges:
        """Widen the angles from the evaluation view over ``progressive_until`` steps."""
        r = 1.0 if self.cfg.progressive_until <= 0 else min(1.0, step / self.cfg.progressive_until)
        start = self.cfg.eval_elevation_deg
        return self.ranges._replace(
            elevation=tuple((1 - r) * start + r * e for e in self.ranges.elevation),
            azimuth=tuple(r * a for a in self.ranges.azimuth),
        )

    def _perturbed(self, orbit: Orbit, rng: torch.Generator) -> Tensor:
        if not self.moves:
            return orbit.c2w
        cfg = self.cfg
        shape = (len(orbit.elevation), 3)
        position = cameras.orbit_positions(orbit.elevation, orbit.azimuth, orbit.distance)
        position = position + (torch.rand(shape, generator=rng) * 2 - 1) * cfg.camera_perturb
        center = torch.randn(shape, generator=rng) * cfg.center_perturb
        up = torch.tensor([0.0, 0.0, 1.0]) + torch.randn(shape, generator=rng) * cfg.up_perturb
        return cameras.look_at(position, center, up)

    def _lights(self, c2w: Tensor, rng: torch.Generator) -> Tensor:
        """Draw point lights around the camera's direction, as DreamFusion does."""
        count, (low, high) = len(c2w), LIGHT_DISTANCES
        towards = c2w[:, :3, 3] + torch.randn(count, 3, generator=rng)
        towards = towards / torch.linalg.vector_norm(towards, dim=-1, keepdim=True).clamp_min(1e-12)
        return towards * (low + (high - low) * torch.rand(count, 1, generator=rng))


class EvalCameras(Dataset, Updateable):
    """A ring of cameras at the evaluation elevation and distance, one view per batch."""

    def __init__(self, cfg: CameraConfig, split: str) -> None:
        self.cfg = cfg
        count = cfg.n_val_views if split == "val" else cfg.n_test_views
        # without 360 degrees, which would repeat the first view in a looped video
        azimuth, same = torch.linspace(0.0, 360.0, count + 1)[:-1], torch.ones(count)
        distance, fovy = same * cfg.eval_camera_distance, same * math.radians(cfg.eval_fovy_deg)
        self.orbit = Orbit(same * cfg.eval_elevation_deg, azimuth, distance, fovy)

    def __len__(self) -> int:
        return len(self.orbit.azimuth)

    def __getitem__(self, index: int) -> int:
        return index

    def collate(self, indices: list[int]) -> dict[str, Any]:
        index = torch.tensor(indices)
        orbit, cfg = self.orbit.rows(index), self.cfg
        return {"index": index, **orbit_batch(orbit, cfg.eval_height, cfg.eval_width, cfg.rays)}


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
        self.val_dataset = EvalCameras(self.cfg, "val")
        self.test_dataset = EvalCameras(self.cfg, "test")

    def train_dataloader(self) -> DataLoader:
        trainer, cameras = self.trainer, self.train_dataset
        if trainer is not None:  # which is at a later step in a resumed run or a later epoch
            cameras.next_step = lambda: trainer.global_step
        return DataLoader(cameras, batch_size=None, collate_fn=cameras.collate)

    def val_dataloader(self) -> DataLoader:
        return DataLoader(self.val_dataset, collate_fn=self.val_dataset.collate)

    def test_dataloader(self) -> DataLoader:
        return DataLoader(self.test_dataset, collate_fn=self.test_dataset.collate)

    predict_dataloader = test_dataloader
