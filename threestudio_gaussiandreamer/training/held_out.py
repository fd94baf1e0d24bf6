"""Held-out scores: compare the cloud with ray-cast views of the mesh that aren't used in training,
composited over the background of the render. PSNR and SSIM, averaged over the views; shares of
views that show another side of the object (multi-face), of the opacity far from the surface
(floater mass) and of pixels with a colour outside [0, 1] (out of gamut); saturation of the colours
relative to the ground truth's."""

import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple, Optional

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from .. import metrics
from ..cameras import Orbit, held_out_orbit
from ..core.errors import UserError
from ..core.files import json_text, write_file
from ..core.options import at_least, in_range, require_memory
from ..images import read as read_image
from ..images import write as write_image
from ..meshes.mesh import SurfaceDistance
from ..meshes.raycast import over_background
from ..view.run_files import read_json
from .data import MAX_SIDE, orbit_batch

VIEW_BYTES = 40
"""Memory per pixel, bytes: ground truth (16), over the background (12), and render (12)."""
RING, RING_SIZE = 24, 32
"""Azimuths that the multi-face rate compares with, and their pixels each way."""


@dataclass
class EvaluationConfig:
    views: int = field(default=24, metadata=in_range(1, 100_000))
    size: int = field(default=256, metadata=in_range(metrics.SMALLEST_SIDE, MAX_SIDE, "pixels"))
    supersample: int = field(default=3, metadata=in_range(1, 64, "rays a pixel each way"))
    every: int = field(default=0, metadata=at_least(0, "steps; 0: never"))

    @staticmethod
    def check(cfg: Any) -> None:
        what = f"{cfg.views} pictures of {cfg.size} x {cfg.size} pixels, twice"
        require_memory("size", VIEW_BYTES * cfg.views * cfg.size**2, what)


class HeldOut:
    """The held-out views and their ground truth, which a :class:`raycast.MeshCaster` casts."""

    def __init__(self, cfg: EvaluationConfig, caster: Any) -> None:
        self.cfg, self.caster = cfg, caster
        self.orbit = held_out_orbit(cfg.views)

    @cached_property
    def truth(self) -> Float[Tensor, "V H W 4"]:
        """Premultiplied colour and coverage of the held-out views."""
        return self._cast(self.orbit, self.cfg.size, self.cfg.supersample)

    @cached_property
    def surface_distance(self) -> SurfaceDistance:
        return SurfaceDistance(self.caster.mesh)

    @cached_property
    def rings(self) -> list[tuple[Tensor, Tensor, Tensor]]:
        """For each pair of elevation and distance: the indices of its held-out views, ``RING``
        azimuths in degrees, and the ground truth at those, (R, h, w, 4).
        """
        azimuth, same, rings = 360.0 * torch.arange(RING) / RING, torch.ones(RING), []
        places = torch.stack([self.orbit.elevation, self.orbit.distance], 1)
        for place in places.unique(dim=0):
            rows = (places == place).all(1).nonzero()[:, 0]
            ring = Orbit(same * place[0], azimuth, same * place[1], same * self.orbit.fovy[0])
            rings.append((rows, azimuth, self._cast(ring, RING_SIZE, 4)))
        return rings

    def _cast(self, orbit: Orbit, size: int, supersample: int) -> Float[Tensor, "V H W 4"]:
        cameras = zip(orbit.c2w.numpy(), orbit.fovy.tolist(), strict=True)
        views = self.caster.render_views(cameras, size, size, supersample=supersample)
        return torch.from_numpy(views)

    @torch.no_grad()
    def render(self, renderer: Any, chunk: int = 4) -> tuple[Tensor, Tensor]:
        """Return unclamped renders (V, H, W, 3) and background colours (V, 3), on the CPU."""
        modes = [(module, module.training) for module in (renderer, renderer.background)]
        for module, _ in modes:
            module.eval()
        images, backgrounds, side = [], [], self.cfg.size * renderer.cfg.downsample
        for start in range(0, self.cfg.views, chunk):
            part = self.orbit.rows(slice(start, start + chunk))
            out = renderer(**orbit_batch(part, side, side))
            images.append(out["comp_rgb"].cpu())
            backgrounds.append(out["comp_rgb_bg"].cpu().mean((1, 2)))
        for module, training in modes:
            module.train(training)
        return torch.cat(images), torch.cat(backgrounds)

    def multi_face(
        self, images: Float[Tensor, "V H W 3"], backgrounds: Float[Tensor, "V 3"]
    ) -> float:
        """Return the fraction of views most similar to a true one over 45 degrees away."""
        wrong = 0.0
        for rows, azimuth, ring in self.rings:
            bank = over_background(ring, backgrounds[rows[0]])
            rate = metrics.multi_face_rate(images[rows], bank, self.orbit.azimuth[rows], azimuth)
            wrong += rate * len(rows)
        return wrong / len(images)

    def floaters(self, means: Float[Tensor, "N 3"], opacities: Float[Tensor, " N"]) -> float:
        """Return the share of the opacity further than 2 % of the longest side from the surface."""
        distances = torch.from_numpy(self.surface_distance(means.double().cpu().numpy()))
        extent = float(np.ptp(self.caster.mesh.vertices, axis=0).max())
        return metrics.floater_mass(distances, opacities.double().cpu(), extent=extent)


CLOCKS = ("seconds", "cpu_seconds")


class Snapshot(NamedTuple):
    """The held-out views of a cloud at one step, not clamped, and what else its scores need."""

    known: dict[str, float]
    images: Float[Tensor, "V H W 3"]
    backgrounds: Float[Tensor, "V 3"]
    means: Float[Tensor, "N 3"]
    opacities: Float[Tensor, " N"]


class Measurements:
    """The scores and training time of a run, stored in ``metrics.json`` and continued on resume:
    ``seconds`` of wall-clock time, and ``cpu_seconds``, the processor time of all threads."""

    def __init__(self, held_out: HeldOut, folder: Path) -> None:
        self.held_out, self.folder = held_out, folder
        self.path = folder / "metrics.json"
        self.values: dict[str, Any] = read_json(self.path, dict)
        self.seconds = np.array([self.values.get(name, 0.0) for name in CLOCKS], np.float64)
        self._started: Optional[np.ndarray] = None
        self._prior: Optional[Snapshot] = None

    def start_clock(self) -> None:
        self._started = _now()

    def stop_clock(self) -> None:
        """Add the time since :meth:`start_clock`, and of what the GPU has left to do."""
        if self._started is not None:
            if torch.cuda.is_available():
                torch.cuda.synchronize()
            self.seconds += _now() - self._started
            self._started = None

    @contextmanager
    def paused_clock(self) -> Iterator[None]:
        """Exclude the time in this context from the training time."""
        running = self._started is not None
        self.stop_clock()
        yield
        if running:
            self.start_clock()

    @torch.no_grad()
    def score(self, key: str, renderer: Any, step: int) -> dict[str, dict[str, Any]]:
        """Score the renderer's cloud after ``step`` optimiser steps, and before it the postponed
        one; store and return the scores by key, "prior", "result", or "curve", which is a list.
        """
        scores = self.score_postponed()
        with self.paused_clock():
            return scores | {key: self._score(key, self._snapshot(renderer, step))}

    @torch.no_grad()
    def begin(self, renderer: Any) -> None:
        """Drop an earlier run's scores; render the prior's cloud for :meth:`score_postponed`."""
        self.values, self.seconds = {}, np.zeros(len(CLOCKS))
        with self.paused_clock():
            self._prior = self._snapshot(renderer, 0)

    @torch.no_grad()
    def score_postponed(self) -> dict[str, dict[str, Any]]:
        """Score the prior's cloud, if postponed (the truth takes seconds); return scores by key."""
        prior, self._prior = self._prior, None
        with self.paused_clock():
            return {"prior": self._score("prior", prior)} if prior else {}

    def _snapshot(self, renderer: Any, step: int) -> Snapshot:
        cloud = renderer.geometry
        images, backgrounds = self.held_out.render(renderer)
        means, opacities = cloud.means.detach().clone(), cloud.opacities().detach().clone()
        known = {"step": step, **self._elapsed(), "gaussians": len(means)}
        return Snapshot(known, images, backgrounds, means, opacities)

    def _score(self, key: str, cloud: Snapshot) -> dict[str, Any]:
        images, held_out = cloud.images.clamp(0, 1), self.held_out
        truth = over_background(held_out.truth, cloud.backgrounds[:, None, None])
        relative = metrics.saturation(images) / max(metrics.saturation(truth), 1e-6)
        scores = cloud.known | {
            "psnr": round(float(metrics.psnr(images, truth).mean()), 3),
            "ssim": round(float(metrics.ssim(images, truth).mean()), 4),
            "multi_face": round(held_out.multi_face(images, cloud.backgrounds), 4),
            "floater_mass": round(held_out.floaters(cloud.means, cloud.opacities), 5),
            "out_of_gamut": round(metrics.out_of_gamut(cloud.images), 5),
            "saturation": round(relative, 4),
        }
        if key == "curve":
            self.values.setdefault("curve", []).append(scores)
        else:
            self.values[key] = scores
            self._save_pictures(key, images, truth)
        self.write()
        return scores

    def _elapsed(self) -> dict[str, float]:
        return dict(zip(CLOCKS, self.seconds.round(3).tolist(), strict=True))

    def write(self) -> None:
        self.values |= self._elapsed()
        self.folder.mkdir(parents=True, exist_ok=True)
        write_file(self.path, json_text(self.values, indent=2))

    def _save_pictures(self, key: str, renders: Tensor, truth: Tensor) -> None:
        """Save rows of six views to ``held_out``, also of prior, result and truth together."""
        folder = self.folder / "held_out"
        folder.mkdir(parents=True, exist_ok=True)
        for name, images in ((key, renders), ("truth", truth)):
            chosen = images[:: max(1, len(images) // 6)][:6]
            row = (torch.cat(list(chosen), 1).clamp(0, 1) * 255).round().byte().numpy()
            write_image(folder / f"{name}.png", row)
        pictures = []
        for name in ("prior", "result", "truth"):
            with suppress(UserError):  # an earlier run's picture is missing or damaged
                pictures.append(read_image(folder / f"{name}.png"))
        if len({picture.shape for picture in pictures}) == 1:
            write_image(folder / "compare.png", np.concatenate(pictures, 0))

    def table(self) -> str:
        """Format a table of the main scores of prior and result."""
        lines = ["              dB     SSIM   multi-face   Gaussians   seconds"]
        for key in ("prior", "result"):
            if v := self.values.get(key):
                face = f"{100 * v['multi_face']:.0f} %"
                lines.append(
                    f"{key:<10}{v['psnr']:6.2f}   {v['ssim']:6.4f}   {face:>10}   "
                    f"{v['gaussians']:9d}   {v['seconds']:7.1f}"
                )
        return "\n".join([*lines, metrics.MULTI_FACE_NOTE])


def _now() -> np.ndarray:
    return np.array([time.perf_counter(), time.process_time()])
