"""Helpers of the densification tests."""

import numpy as np
import torch

from threestudio_gaussiandreamer.cameras import orbit_c2w
from threestudio_gaussiandreamer.gaussians.point_cloud import PointCloud
from threestudio_gaussiandreamer.host import find
from threestudio_gaussiandreamer.metrics import psnr
from threestudio_gaussiandreamer.training.density import DensityControl
from threestudio_gaussiandreamer.training.geometry import GaussianCloud

NO_LIMITS = {"min_opacity": 0.0, "max_scale": 1e9}


EVERY_STEP = {"enabled": True, "start": 1, "stop": 10_000, "every": 1}


def ball(n: int = 200, seed: int = 0) -> PointCloud:
    rng = np.random.default_rng(seed)
    points = rng.normal(size=(n, 3))
    points *= 0.7 / np.linalg.norm(points, axis=1, keepdims=True)
    return PointCloud(points.astype(np.float32), rng.random((n, 3), np.float32))


def started(n: int = 200, seed: int = 0, **options) -> GaussianCloud:
    geometry = GaussianCloud({"grow": {"enabled": False}, "init_opacity": 0.5, **options})
    geometry.start_from(ball(n, seed))
    return geometry


class Training:
    """The system's training step with the package's own parts, fitting renders of another cloud
    from four fixed cameras.
    """

    def __init__(self, geometry: GaussianCloud, size: int = 32) -> None:
        self.geometry, self.size, self.step = geometry, size, 0
        angles = torch.arange(4)
        self.c2w, self.fovy = (
            orbit_c2w(10.0 * angles, 90.0 * angles + 20, torch.full((4,), 2.5)),
            torch.full((4,), 0.8),
        )
        self.truth = self.render(started(150, seed=1, init_opacity=0.9), slice(None))[
            "comp_rgb"
        ].detach()
        self.optimizer = torch.optim.Adam(
            [{**group, "lr": 1e-2} for group in geometry.parameter_groups()],
            betas=(0.9, 0.99),
            eps=1e-15,
        )

    def render(self, geometry: GaussianCloud, views: slice) -> dict:
        behind = find("gaussiandreamer-background")({"mode": "fixed", "color": [1.0, 1.0, 1.0]})
        renderer = find("gaussiandreamer-splatting")(
            {}, geometry=geometry, material=None, background=behind
        )
        return renderer(self.c2w[views], self.fovy[views], self.size, self.size)

    def observe(self, views: slice, loss_scale: float = 1.0) -> None:
        """Render, backpropagate and update the statistics; return the batch mean of each view's
        mean squared error.
        """
        out = self.render(self.geometry, views)
        loss = ((out["comp_rgb"] - self.truth[views]) ** 2).mean()
        (loss * loss_scale).backward()
        DensityControl(self.geometry).after_backward(
            out["rasterized"], self.size, self.size, loss_scale
        )

    def run(self, steps: int) -> list[int]:
        """Return the number of Gaussians after each step."""
        counts = []
        for _ in range(steps):
            self.observe(slice(None))
            self.optimizer.step()
            self.optimizer.zero_grad(set_to_none=True)
            self.step += 1
            DensityControl(self.geometry).after_step(self.optimizer, self.step)
            counts.append(len(self.geometry))
        return counts

    @torch.no_grad()
    def quality(self) -> float:
        return psnr(self.render(self.geometry, slice(None))["comp_rgb"], self.truth).mean().item()


SCHEDULES = [f"system.geometry.{key}" for key in (
    "prior.num_points=180", "init_opacity=0.3", "budget=100", "densify.enabled=true",
    "densify.start=30", "densify.stop=95", "densify.every=10", "densify.grad_threshold=1e-4",
    "densify.min_opacity=0.4", "densify.absgrad=true", "prune.start=15", "prune.stop=95",
    "prune.every=15", "prune.keep=0.8",
)]  # fmt: skip
