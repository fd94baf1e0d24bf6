"""Geometry ``gaussiandreamer-cloud``: a cloud of 3D Gaussians that starts from a 3D prior.

Parameters (the names say how they are stored): ``means`` (N, 3) world units, ``log_scales`` (N, 3),
``quats`` (N, 4) wxyz, ``logit_opacities`` (N,), ``sh0`` (N, 1, 3) and ``sh_rest`` (N, K - 1, 3)
with K = (sh_degree + 1)^2. The cloud is empty until :meth:`initialize` runs the prior or a
checkpoint is loaded; it takes its size from the checkpoint, so the prior isn't needed again.

==================  ================================================================================
option              meaning
==================  ================================================================================
prior_type, prior   the registered prior and its options
grow                Algorithm 1 of the paper: enabled, num_candidates, radius (share of the longest
                    side of the points' bounding box), color_range, clamp, max_points
scale_rule          first standard deviation: ``nearest`` (the paper: distance to the nearest point)
                    or ``rms3`` (the released code: root mean square distance to the three nearest)
scale_factor        multiplies it
init_opacity        opacity of every Gaussian at the start
sh_degree           0 to 3
lr_*                learning rate of each attribute: a number or a schedule; lr_sh_rest for the
                    bands above degree 0
densify             enabled, start, stop, every (steps), grad_threshold, split_scale, min_opacity,
                    max_scale (world units); absgrad: judge by the sum of the pixels' absolute
                    gradients, in which opposite pulls don't cancel (AbsGS, Ye et al. 2024; several
                    times larger, so give a threshold to match)
budget              how many Gaussians a run ends with: a number, null or none (no limit but
                    ``max_gaussians``), or ``auto``: each round drops as many as cost no more than
                    its share of ``prune.quality`` or, where no truth is known, ``prune.likeness``;
                    under a budget, duplicates in the start are merged (``merging.py``)
prune               how the budget is met (``importance.py``): start, stop, every (steps), keep (the
                    share that a round keeps; less only where there are too few rounds for a budget
                    that is a number), score (removal, contribution; opacity, random: to compare
                    with), quality (dB that all rounds may lose against the truth), likeness (dB
                    between the renders before and after a round, at least); ``auto`` leaves out the
                    first half of the rounds: what looks superfluous early may be needed later
max_gaussians       exact cap, reached by dropping what shows least (of untrained points: any,
                    evenly); min_gaussians: the floor that pruning never passes
keep_attributes     with gaussians-prior: start from all attributes of that cloud, not only from
                    points and colours
==================  ================================================================================
"""

import contextlib
import logging
import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any, List

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from ..core.errors import UserError
from ..core.memory import count_of
from ..core.nested import adopt_nested
from ..core.options import (
    at_least,
    between,
    check_options,
    in_range,
    interval,
    is_whole,
    one_of,
    positive,
    schedule,
    shown,
)
from ..core.streams import numpy_generator
from ..gaussians import densify, importance, sh, simplify
from ..gaussians.densify import LOG_SCALE_RANGE, PARAMETERS, Change
from ..gaussians.gaussians import Gaussians
from ..gaussians.grow import SCALE_RULES, grow, nearest_distance_scales
from ..gaussians.merge import merge_duplicates
from ..gaussians.point_cloud import PointCloud
from ..host import BaseGeometry, C, find, register, run_seed
from .density import AUTO, min_count

logger = logging.getLogger(__name__)
STATISTICS = ("gradient_sum", "gradient_count", "contribution", "removal")
LEARNING_RATES = {
    "means": "lr_means",
    "log_scales": "lr_scales",
    "quats": "lr_quats",
    "logit_opacities": "lr_opacities",
    "sh0": "lr_sh",
    "sh_rest": "lr_sh_rest",
}
CAP_VIEWS = (32, 256)
"""How many views a trained cloud that is too large is judged by, and their pixels each way."""


@dataclass
class GrowConfig:
    enabled: bool = True
    num_candidates: int = field(default=1_000_000, metadata=count_of("candidates", 0, 48))
    radius: float = field(default=0.01, metadata=positive())
    color_range: List[float] = field(default_factory=lambda: [0.0, 0.2], metadata=interval())
    clamp: bool = True
    max_points: int = field(default=400_000, metadata=at_least(0))


@dataclass
class DensifyConfig:
    enabled: bool = False
    start: int = field(default=400, metadata=at_least(0))
    stop: int = field(default=900, metadata=at_least(0))
    every: int = field(default=100, metadata=at_least(1))
    grad_threshold: float = field(default=2e-4, metadata=at_least(0))
    split_scale: float = field(default=0.04, metadata=positive())
    min_opacity: float = field(default=0.05, metadata=in_range(0, 1 - 1e-6))
    max_scale: float = field(default=0.4, metadata=positive("world units"))
    absgrad: bool = False

    @staticmethod
    def check(cfg: Any) -> None:
        if cfg.enabled:
            require_order(cfg)


@dataclass
class PruneConfig:
    start: int = field(default=100, metadata=at_least(0))
    stop: int = field(default=900, metadata=at_least(0))
    every: int = field(default=50, metadata=at_least(1))
    keep: float = field(default=0.8, metadata=between(0, 1))
    score: str = field(default="removal", metadata=one_of(importance.SCORES))
    quality: float = field(default=0.1, metadata=at_least(0, "dB"))
    likeness: float = field(default=40.0, metadata=at_least(0, "dB"))

    @staticmethod
    def check(cfg: Any) -> None:
        require_order(cfg)


def require_order(cfg: Any) -> None:
    """Raise UserError unless a schedule of rounds starts before it stops."""
    if cfg.start >= cfg.stop:
        raise UserError(f"stop: expected more than start ({cfg.start}), got {cfg.stop}")


@register("gaussiandreamer-cloud")
class GaussianCloud(BaseGeometry):
    @dataclass
    class Config(BaseGeometry.Config):
        prior_type: str = "random-prior"
        prior: dict = field(default_factory=dict)
        grow: GrowConfig = field(default_factory=GrowConfig)
        scale_rule: str = field(default="nearest", metadata=one_of(SCALE_RULES))
        scale_factor: float = field(default=1.0, metadata=positive())
        init_opacity: float = field(default=0.1, metadata=between(0, 1))
        sh_degree: int = field(default=0, metadata=in_range(0, 3))
        keep_attributes: bool = True
        lr_means: Any = field(default=5e-5, metadata=schedule(min=0))
        lr_scales: Any = field(default=1e-3, metadata=schedule(min=0))
        lr_quats: Any = field(default=1e-2, metadata=schedule(min=0))
        lr_opacities: Any = field(default=1e-2, metadata=schedule(min=0))
        lr_sh: Any = field(default=1.25e-2, metadata=schedule(min=0))
        lr_sh_rest: Any = field(default=6.25e-4, metadata=schedule(min=0))
        densify: DensifyConfig = field(default_factory=DensifyConfig)
        budget: Any = None
        prune: PruneConfig = field(default_factory=PruneConfig)
        max_gaussians: int = field(default=500_000, metadata=at_least(1))
        min_gaussians: int = field(default=64, metadata=at_least(1))

        def __post_init__(self) -> None:
            adopt_nested(self)
            self.budget = _as_budget(self.budget)

        @staticmethod
        def check(cfg: Any) -> None:
            if cfg.max_gaussians < cfg.min_gaussians:
                raise UserError(
                    f"max_gaussians: expected min_gaussians ({cfg.min_gaussians}) or more, got "
                    f"{cfg.max_gaussians}"
                )
            _check_budget(cfg)

    cfg: Config

    def configure(self) -> None:
        check_options(self.Config, self.cfg, "system.geometry.")
        self.bands = (self.cfg.sh_degree + 1) ** 2
        self._warned = False
        self._allocate(0)

    # -- size --------------------------------------------------------------------------------------

    def __len__(self) -> int:
        return len(self.means)

    def _shapes(self, n: int) -> dict[str, tuple[int, ...]]:
        harmonics = {"sh0": (n, 1, 3), "sh_rest": (n, self.bands - 1, 3)}
        return {
            "means": (n, 3),
            "log_scales": (n, 3),
            "quats": (n, 4),
            "logit_opacities": (n,),
            **harmonics,
        }

    def _allocate(self, n: int, device: torch.device | str = "cpu") -> None:
        for name, shape in self._shapes(n).items():
            setattr(self, name, nn.Parameter(torch.zeros(shape, device=device)))
        for name in STATISTICS:
            self.register_buffer(name, torch.zeros(n, device=device))

    def _load_from_state_dict(
        self, state_dict: dict[str, Tensor], prefix: str, *args: Any, **kwargs: Any
    ) -> None:
        """Take the size from the checkpoint before its tensors are copied in."""
        means = state_dict.get(prefix + "means")
        if (
            isinstance(means, Tensor) and means.dim() and len(means) != len(self)
        ):  # otherwise torch says what is wrong with it
            self._allocate(len(means), self.means.device)
        if prefix + "means" in state_dict:
            state_dict.setdefault(
                prefix + "removal", torch.zeros(len(self))
            )  # older checkpoints have none
        super()._load_from_state_dict(state_dict, prefix, *args, **kwargs)

    # -- derived quantities ------------------------------------------------------------------------

    def scales(self) -> Float[Tensor, "N 3"]:
        """Standard deviations along the axes, world units; clamped where exp would over- or
        underflow float32.
        """
        return self.log_scales.clamp(*LOG_SCALE_RANGE).exp()

    def opacities(self) -> Float[Tensor, " N"]:
        return torch.sigmoid(self.logit_opacities)

    @property
    def sh(self) -> Float[Tensor, "N K 3"]:
        """All bands of the spherical harmonics."""
        return torch.cat([self.sh0, self.sh_rest], 1)

    def colors(
        self, camera_positions: Float[Tensor, "B 3"]
    ) -> Float[Tensor, "N 3"] | Float[Tensor, "B N 3"]:
        """RGB, not negative; per view when the spherical harmonics have more than the constant
        band.
        """
        if self.bands == 1:
            return sh.sh0_to_rgb(self.sh0[:, 0]).clamp_min(0.0)
        dirs = torch.nn.functional.normalize(
            self.means.detach()[None] - camera_positions[:, None], dim=-1
        )
        return sh.sh_to_colors(self.sh, dirs)

    # -- start -------------------------------------------------------------------------------------

    def prior(self) -> Any:
        """The prior of the configuration, which hasn't run yet."""
        return find(self.cfg.prior_type)(self.cfg.prior)

    def initialize(self, prompt: str, make_cloud: Any = None) -> PointCloud:
        """Run the prior, grow and perturb its points, and start one Gaussian on each; returns the
        prior's points.

        ``make_cloud(prior, prompt)`` may stand in for ``prior(prompt)``, for instance to read a
        cached result."""
        prior = self.prior()
        if self.cfg.keep_attributes and hasattr(prior, "gaussians"):
            arrays = prior.gaussians(prompt)
            self.set_arrays(**self._capped_trained(arrays.tensors())._asdict())
            cloud = prior.cloud(arrays)
        else:
            cloud = make_cloud(prior, prompt) if make_cloud else prior(prompt)
            ground = prior.ground_count() if hasattr(prior, "ground_count") else 0
            self.start_from(self.grown(cloud, ground))
        if self.cfg.budget is not None:
            self.merge_duplicates()
        return cloud

    def merge_duplicates(self) -> None:
        """One Gaussian in the place of those that show the same, as far as the budget asks for
        fewer.
        """
        merged = merge_duplicates(self.parameters_by_name(), at_least=min_count(self.cfg)).values
        if len(merged["means"]) < len(self):
            logger.info(
                "%d of %d Gaussians are duplicates of others: merged",
                len(self) - len(merged["means"]),
                len(self),
            )
            self.set_arrays(sh=torch.cat([merged.pop("sh0"), merged.pop("sh_rest")], 1), **merged)

    def grown(self, cloud: PointCloud, ground: int = 0) -> PointCloud:
        """Grow points and perturb their colours (the paper's Algorithm 1), within the cap.

        Args:
            ground: how many points at the end of ``cloud`` are a prior's ground: they neither grow
                nor count for the box, and stay at the end.
        """
        if not self.cfg.grow.enabled:
            return cloud
        if ground:
            figure, layer = cloud.split(len(cloud.points) - ground)
            return self.grown(figure).followed_by(layer)
        options = {
            k: v for k, v in dict(self.cfg.grow).items() if k not in ("enabled", "color_range")
        }
        return grow(
            cloud,
            color_range=tuple(self.cfg.grow.color_range),
            **options,
            generator=numpy_generator(run_seed(), "grow"),
        )

    def start_from(self, cloud: PointCloud) -> None:
        """One Gaussian on each point: its colour, opacity ``init_opacity``, an isotropic scale from
        the nearest distances.
        """
        points, colors = self._capped(cloud.points, cloud.colors)
        n, scales = (
            len(points),
            nearest_distance_scales(points, self.cfg.scale_rule) * self.cfg.scale_factor,
        )
        harmonics = np.zeros((n, self.bands, 3), np.float32)
        harmonics[:, 0] = sh.rgb_to_sh0(
            torch.from_numpy(np.ascontiguousarray(colors, np.float32))
        ).numpy()
        self.set_arrays(
            means=points,
            log_scales=np.repeat(np.log(scales)[:, None], 3, 1),
            quats=np.tile(np.float32([1, 0, 0, 0]), (n, 1)),
            logit_opacities=np.full(
                n, math.log(self.cfg.init_opacity / (1 - self.cfg.init_opacity))
            ),
            sh=harmonics,
        )

    def _capped(self, points: np.ndarray, colors: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """At most ``max_gaussians`` points, a seeded uniform choice.

        None of them is trained and all are equally opaque, so none is worth more than another: a
          choice by contribution to first
        renders would only prefer what lies outside, and leave holes (tests/stability measures
        both)."""
        if len(points) <= self.cfg.max_gaussians:
            return points, colors
        logger.warning(
            "the prior and its growth give %d points; keeping %d, evenly (max_gaussians)",
            len(points),
            self.cfg.max_gaussians,
        )
        rows = np.sort(
            numpy_generator(run_seed(), "cap").choice(
                len(points), self.cfg.max_gaussians, replace=False
            )
        )
        return points[rows], colors[rows]

    def _capped_trained(self, cloud: Gaussians) -> Gaussians:
        """At most ``max_gaussians`` of trained Gaussians: those that show most in views from all
        around.
        """
        if len(cloud.means) <= self.cfg.max_gaussians:
            return cloud
        logger.warning(
            "the prior has %d Gaussians; keeping the %d that show most (max_gaussians)",
            len(cloud.means),
            self.cfg.max_gaussians,
        )
        cloud = cloud.tensors(self.means.device)
        shown = simplify.worth(cloud, simplify.views_around(cloud, *CAP_VIEWS))
        return simplify.only(cloud, shown, self.cfg.max_gaussians)

    def set_arrays(self, *, sh: Any, **arrays: Any) -> None:
        """Replace the cloud; spherical harmonics ``sh`` (N, K', 3) are padded with zeros or cut to
        ``sh_degree``.
        """
        device = self.means.device
        self._allocate(len(arrays["means"]), device)
        with torch.no_grad():
            for name, value in arrays.items():
                getattr(self, name).copy_(torch.as_tensor(value))
            bands = torch.as_tensor(sh)[:, : self.bands].to(device)
            self.sh0.copy_(bands[:, :1])
            self.sh_rest[:, : bands.shape[1] - 1] = bands[:, 1:]
            self.logit_opacities.clamp_(-15.0, 15.0)
            self.log_scales.clamp_(*LOG_SCALE_RANGE)

    @torch.no_grad()
    def warn_of_clamped_sizes(self) -> None:
        """Say once that some Gaussians are drawn at the bounds of ``LOG_SCALE_RANGE``."""
        low, high = LOG_SCALE_RANGE
        clamped = ((self.log_scales < low) | (self.log_scales > high)).any(-1)
        if self._warned or not clamped.any():
            return
        self._warned = True
        logger.warning(
            "%d of %d Gaussians are drawn at e^%g or e^%g, the bounds of their sizes; the first is "
            "number %d",
            clamped.sum(),
            len(self),
            low,
            high,
            clamped.nonzero()[0],
        )

    def parameters_by_name(self) -> dict[str, nn.Parameter]:
        return {name: getattr(self, name) for name in PARAMETERS}

    # -- optimisation ------------------------------------------------------------------------------

    def parameter_groups(self) -> list[dict[str, Any]]:
        """One optimiser group per attribute, named after it; the rates are set every step by
        :meth:`set_learning_rates`.
        """
        named = self.parameters_by_name().items()
        return [
            {"params": [parameter], "name": name, "lr": 0.0}
            for name, parameter in named
            if parameter.numel() or name != "sh_rest"
        ]

    def set_learning_rates(self, optimizer: torch.optim.Optimizer, epoch: int, step: int) -> None:
        for group in optimizer.param_groups:
            if group.get("name") in LEARNING_RATES:
                group["lr"] = C(self.cfg[LEARNING_RATES[group["name"]]], epoch, step)

    @property
    def wants_absgrad(self) -> bool:
        """Whether densification reads absolute gradients, which the rasteriser then collects."""
        return self.cfg.densify.enabled and self.cfg.densify.absgrad

    @contextlib.contextmanager
    def showing_only(self, kept: Bool[Tensor, " N"]) -> Iterator[None]:
        """Draw only the marked Gaussians in this context; the others get no opacity."""
        logits = self.logit_opacities.detach().clone()
        with torch.no_grad():
            self.logit_opacities[~kept] = -100.0
        try:
            yield
        finally:
            with torch.no_grad():
                self.logit_opacities.copy_(logits)

    def apply_change(self, change: Change, optimizer: torch.optim.Optimizer) -> None:
        """Replace the cloud by ``change``, move the optimiser's rows along and clear the
        statistics.
        """
        old = self.parameters_by_name()
        new = {name: nn.Parameter(value) for name, value in change.values.items()}
        densify.update_optimizer(optimizer, old, new, change)
        for name, parameter in new.items():
            setattr(self, name, parameter)
        for name in STATISTICS:
            self.register_buffer(name, torch.zeros(len(change.parents), device=self.means.device))


def _as_budget(given: Any) -> Any:
    """What was given for a budget, with ``none`` as None and whole numbers as such, however they
    are written.
    """
    if isinstance(given, str):
        given = given.lower()
        with contextlib.suppress(ValueError):
            given = float(given)  # 5e3 is text to PyYAML
    if given == "none":
        return None
    return int(given) if isinstance(given, float) and given.is_integer() else given


def _check_budget(cfg: Any) -> None:
    """Raise UserError for a budget that can't be met."""
    if cfg.budget in (None, AUTO) or is_whole(cfg.budget) and cfg.budget >= cfg.min_gaussians:
        return
    raise UserError(
        "budget: expected none, auto or a number from min_gaussians "
        f"({cfg.min_gaussians}) on, got {shown(cfg.budget)}"
    )
