"""Data module ``gaussiandreamer-datamodule``: random training cameras, a ring of validation and
test cameras.

Batch keys, units and options are those of threestudio's ``random-camera-datamodule``, under whose
name it is also registered in the built-in host. There are three differences. Rays are computed only
with ``rays: true``, since splatting doesn't need them, and at 4 x 1024^2 they take half a second of
CPU time per step. A batch is a function of (seed, step), so a resumed run has the same cameras as
an uninterrupted one. Step k is trained with the batch of step k: no batch is prefetched with the
previous resolution, and there is no degenerate third batch.

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
from typing import Any, Optional

import torch
from jaxtyping import Int
from torch import Tensor
from torch.utils.data import DataLoader, Dataset, IterableDataset

from .. import cameras
from ..cameras import Orbit, OrbitRanges
from ..core.distributed import own_rows, require_shareable
from ..core.streams import generator
from ..host import Updateable, parse_structured, pl, register, register_builtin, run_seed
from .camera_options import CameraConfig, sizes_of_stages


def make_batch(
    orbit: Orbit,
    c2w: Tensor,
    light_positions: Tensor,
    height: int,
    width: int,
    rays: bool = False,
    normalize: bool = True,
) -> dict[str, Any]:
    """Make the host's batch of B views: tensors in the host's conventions, ``height`` and ``width``
    as plain ints.
    """
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
        batch["rays_d"] = cameras.ray_directions(c2w, orbit.fovy, height, width, normalize)
        batch["rays_o"] = c2w[:, None, None, :3, 3].expand_as(batch["rays_d"]).clone()
    return batch


def orbit_batch(orbit: Orbit, height: int, width: int, *rays: bool) -> dict[str, Any]:
    """Make the host's batch of the views of ``orbit``, with the lights at the cameras."""
    c2w = orbit.c2w
    return make_batch(orbit, c2w, c2w[:, :3, 3].clone(), height, width, *rays)


class TrainCameras(IterableDataset, Updateable):
    """An endless stream of training batches, each epoch's from the step that ``next_step``
    returns.
    """

    def __init__(self, cfg: CameraConfig) -> None:
        self.cfg = cfg
        self.next_step: Callable[[], int] = lambda: 0
        self._views_by_size: dict[tuple[int, int], dict[str, Any]] = {}
        self.sizes = sizes_of_stages(cfg)
        for _, _, batch_size in self.sizes:
            require_shareable(batch_size, "data.batch_size", together=cfg.n_view)
        angles = cfg.elevation_range, cfg.azimuth_range
        self.ranges = OrbitRanges(*map(tuple, (*angles, cfg.camera_distance_range, cfg.fovy_range)))
        self.pool = None
        if cfg.train_views:
            self.pool = cameras.camera_pool(cfg.train_views, self.ranges, run_seed())

    def __iter__(self):
        yield from itertools.count(self.next_step())

    def collate(self, step: int) -> dict[str, Any]:
        """Return this process's views of the batch for ``step``, a function of (seed, step)."""
        height, width, batch_size = self.sizes[
            bisect.bisect_right(self.cfg.resolution_milestones, step)
        ]
        rng, rows = generator(run_seed(), "camera", step), own_rows(batch_size)
        index = self._pick(batch_size, rng) if self.pool else None
        if self.pool and not (self.moves or self.cfg.rays):
            views = self._views_of_pool(height, width)
            lights = self._lights(views["c2w"][index], rng)[rows]
            batch = {k: v[index[rows]] if torch.is_tensor(v) else v for k, v in views.items()}
            return batch | {"light_positions": lights}
        if self.pool:
            orbit = self.pool.rows(index)
        else:
            orbit = self._sample(batch_size, self._ranges(step), rng)
        c2w = self._perturbed(orbit, rng)
        lights = self._lights(c2w, rng)
        own, rays = (orbit.rows(rows), c2w[rows], lights[rows]), self.cfg.rays
        return make_batch(*own, height, width, rays, self.cfg.rays_d_normalize)

    def _views_of_pool(self, height: int, width: int) -> dict[str, Any]:
        """Return one batch of all views of the pool, with any lights."""
        if (height, width) not in self._views_by_size:
            self._views_by_size[height, width] = orbit_batch(self.pool, height, width)
        return self._views_by_size[height, width]

    def _sample(self, batch_size: int, ranges: OrbitRanges, rng: torch.Generator) -> Orbit:
        uniform = self.cfg.batch_uniform_azimuth
        if self.cfg.n_view == 1:
            return cameras.sample_orbit(batch_size, ranges, rng, uniform)
        return cameras.sample_view_groups(batch_size, self.cfg.n_view, ranges, rng, uniform)

    def _pick(self, batch_size: int, rng: torch.Generator) -> Int[Tensor, " B"]:
        """Draw ``batch_size`` views of the pool, one from each azimuth sector (the pool is ordered
        by azimuth).
        """
        u, views = torch.rand(batch_size, generator=rng), len(self.pool.azimuth)
        sector = (
            (u + torch.arange(batch_size)) / batch_size if self.cfg.batch_uniform_azimuth else u
        )
        return (sector * views).long().clamp_max(views - 1)

    def _ranges(self, step: int) -> OrbitRanges:
        """Widen elevation and azimuth from the evaluation view to the full range over
        ``progressive_until`` steps.
        """
        r = 1.0 if self.cfg.progressive_until <= 0 else min(1.0, step / self.cfg.progressive_until)
        start = self.cfg.eval_elevation_deg
        return self.ranges._replace(
            elevation=tuple((1 - r) * start + r * e for e in self.ranges.elevation),
            azimuth=tuple(r * a for a in self.ranges.azimuth),
        )

    @property
    def moves(self) -> bool:
        """Whether cameras are shifted at random."""
        return bool(self.cfg.camera_perturb or self.cfg.center_perturb or self.cfg.up_perturb)

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
        count, (low, high) = len(c2w), self.cfg.light_distance_range
        noise = torch.randn(count, 3, generator=rng) * self.cfg.light_position_perturb
        towards = c2w[:, :3, 3] + noise
        # as torch's normalize, which takes several times longer on so few numbers
        towards = towards / torch.linalg.vector_norm(towards, dim=-1, keepdim=True).clamp_min(1e-12)
        return towards * (low + (high - low) * torch.rand(count, 1, generator=rng))


class EvalCameras(Dataset, Updateable):
    """A ring of cameras at the evaluation elevation and distance, one view per batch."""

    def __init__(self, cfg: CameraConfig, split: str) -> None:
        self.cfg = cfg
        count = cfg.n_val_views if split == "val" else cfg.n_test_views
        # without 360 degrees, which would repeat the first view in a looped video
        azimuth = torch.linspace(0.0, 360.0, count + 1)[:-1]
        same = torch.ones(count)
        self.orbit = Orbit(
            same * cfg.eval_elevation_deg,
            azimuth,
            same * cfg.eval_camera_distance,
            same * math.radians(cfg.eval_fovy_deg),
        )

    def __len__(self) -> int:
        return len(self.orbit.azimuth)

    def __getitem__(self, index: int) -> int:
        return index

    def collate(self, indices: list[int]) -> dict[str, Any]:
        index = torch.tensor(indices)
        orbit, cfg = self.orbit.rows(index), self.cfg
        rays = cfg.rays, cfg.rays_d_normalize
        return {"index": index, **orbit_batch(orbit, cfg.eval_height, cfg.eval_width, *rays)}


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
        trainer = self.trainer
        if trainer is not None:  # which is at a later step in a resumed run or a later epoch
            self.train_dataset.next_step = lambda: trainer.global_step
        cameras = self.train_dataset
        return DataLoader(cameras, batch_size=None, collate_fn=cameras.collate)

    def pool_views(self) -> Optional[dict[str, Any]]:
        """Return ``c2w``, ``fovy``, ``height``, ``width``, ``batch_size`` of all views of a fixed
        pool; None where those change.
        """
        cameras = self.train_dataset
        if cameras.pool is None or cameras.moves or len(cameras.sizes) > 1:
            return None
        sizes = dict(zip(("height", "width", "batch_size"), cameras.sizes[0], strict=True))
        return {"c2w": cameras.pool.c2w, "fovy": cameras.pool.fovy, **sizes}

    def views_to_prefetch(self, steps: float) -> Optional[dict[str, Any]]:
        """Return :meth:`pool_views` if ``steps`` more steps will draw about as many views."""
        views = self.pool_views()
        if views is None or steps * views["batch_size"] < len(views["c2w"]):
            return None
        return views

    def val_dataloader(self) -> DataLoader:
        return self._in_order(self.val_dataset)

    def test_dataloader(self) -> DataLoader:
        return self._in_order(self.test_dataset)

    def _in_order(self, views: EvalCameras) -> DataLoader:
        return DataLoader(views, batch_size=self.cfg.eval_batch_size, collate_fn=views.collate)

    predict_dataloader = test_dataloader
