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
bound_colors        keep colours in [0, 1], which is all that viewers show: the constant band is
                    clamped after each step, and the colour that a view sees as it is drawn
lr_*                learning rate of each attribute: a number or a schedule; lr_sh_rest for the
                    bands above degree 0
lr_means_unit       of lr_means: ``world`` units, or ``size``: standard deviations of each Gaussian
                    along its own axes, so that a step moves large ones farther than small ones
densify             enabled, start, stop, every (steps), grad_threshold, split_scale, min_opacity,
                    max_scale (world units); absgrad: compare the sum of the pixels' absolute
                    gradients, in which opposite signs don't cancel (AbsGS, Ye et al. 2024), with
                    the threshold; it is several times larger
budget              how many Gaussians a run ends with: a number, null or none (no limit but
                    ``max_gaussians``), or ``auto``: as many as the scene needs, so that twice as
                    many would gain less than ``prune.gain`` dB; under a budget, duplicates in the
                    start are merged (``merge.py``)
prune               how the budget is met (``importance.py``): start, stop, every (steps), keep (the
                    share that a round keeps; less only where there are too few rounds for a budget
                    that is a number), gain (dB, of ``auto``), likeness (dB, of ``auto`` where no
                    truth is known: the error of the renders is taken to be that of this PSNR)
max_gaussians       largest count: those with the least importance are dropped (of untrained points:
                    a uniform choice); min_gaussians: the least count that pruning leaves
density_type,       the rule that changes the number of Gaussians, and its options; densify, budget
density             and prune are those of the default one, ``density.py``
keep_attributes     with gaussians-prior: start from all attributes of that cloud, not only from
                    points and colours
==================  ================================================================================
"""

import contextlib
import logging
import math
from dataclasses import dataclass, field
from typing import Any, List

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn

from ..core.errors import UserError
from ..core.options import (
    at_least,
    between,
    count_of,
    in_range,
    interval,
    is_whole,
    one_of,
    positive,
    schedule,
    shown,
)
from ..core.schedule import parse_schedule
from ..core.streams import numpy_generator
from ..gaussians import densify, sh
from ..gaussians.densify import LOG_SCALE_RANGE, PARAMETERS, Change
from ..gaussians.gaussians import SHAPES, Gaussians, require_cloud
from ..gaussians.grow import SCALE_RULES, grow, nearest_distance_scales
from ..gaussians.merge import merge_duplicates
from ..gaussians.point_cloud import PointCloud
from ..gaussians.simplify import keep_best, view_importance
from ..gaussians.views import views_around
from ..host import BaseGeometry, C, find, register, run_seed, warn
from ..host.methods import require_method
from .density import AUTO, DensifyConfig, PruneConfig, min_count

logger = logging.getLogger(__name__)
CAP_VIEWS = (32, 256)
"""Views that rank the Gaussians of a trained cloud that is too large, and their pixels each way."""
STATISTICS = ("gradient_sum", "gradient_count", "contribution", "removal")
AUTO_STATE = {"error": 0.0, "gain": -1.0, "started_with": 0.0}
"""Numbers of a run: squared error of the views in which ``removal`` was sampled, dB that twice as
many Gaussians would gain (see ``importance.Need``), and their number at the start."""
LEARNING_RATES = {
    "means": "lr_means",
    "log_scales": "lr_scales",
    "quats": "lr_quats",
    "logit_opacities": "lr_opacities",
    "sh0": "lr_sh",
    "sh_rest": "lr_sh_rest",
}


@dataclass
class GrowConfig:
    enabled: bool = True
    num_candidates: int = field(default=1_000_000, metadata=count_of("candidates", 0, 48))
    radius: float = field(default=0.01, metadata=positive(most=100))
    color_range: List[float] = field(default_factory=lambda: [0.0, 0.2], metadata=interval())
    clamp: bool = True
    max_points: int = field(default=400_000, metadata=at_least(0))


@register("gaussiandreamer-cloud")
class GaussianCloud(BaseGeometry):
    @dataclass
    class Config(BaseGeometry.Config):
        prior_type: str = "random-prior"
        prior: dict = field(default_factory=dict)
        grow: GrowConfig = field(default_factory=GrowConfig)
        scale_rule: str = field(default="nearest", metadata=one_of(SCALE_RULES))
        scale_factor: float = field(default=1.0, metadata=positive(most=1e6))
        init_opacity: float = field(default=0.1, metadata=between(0, 1))
        sh_degree: int = field(default=0, metadata=in_range(0, 3))
        bound_colors: bool = True
        keep_attributes: bool = True
        lr_means: Any = field(default=5e-5, metadata=schedule(min=0, max=1e6))
        lr_means_unit: str = field(default="world", metadata=one_of(("world", "size")))
        lr_scales: Any = field(default=1e-3, metadata=schedule(min=0, max=1e6))
        lr_quats: Any = field(default=1e-2, metadata=schedule(min=0, max=1e6))
        lr_opacities: Any = field(default=1e-2, metadata=schedule(min=0, max=1e6))
        lr_sh: Any = field(default=1.25e-2, metadata=schedule(min=0, max=1e6))
        lr_sh_rest: Any = field(default=6.25e-4, metadata=schedule(min=0, max=1e6))
        densify: DensifyConfig = field(default_factory=DensifyConfig)
        budget: Any = None
        prune: PruneConfig = field(default_factory=PruneConfig)
        max_gaussians: int = field(default=500_000, metadata=at_least(1))
        min_gaussians: int = field(default=64, metadata=at_least(1))
        density_type: str = "gaussiandreamer-density"
        density: dict = field(default_factory=dict)

        def __post_init__(self) -> None:
            if isinstance(self.budget, str):
                self.budget = None if self.budget.lower() == "none" else self.budget.lower()
                with contextlib.suppress(TypeError, ValueError):
                    self.budget = float(self.budget)
            if isinstance(self.budget, float) and self.budget.is_integer():
                self.budget = int(self.budget)  # 5e3

        @staticmethod
        def check(cfg: Any) -> None:
            if cfg.lr_means_unit == "size" and max(parse_schedule(cfg.lr_means).values) < 1e-3:
                warn(
                    "lr_means is less than 0.001 standard deviations of a Gaussian: for a rate in "
                    "world units set lr_means_unit=world"
                )
            if cfg.max_gaussians < cfg.min_gaussians:
                raise UserError(
                    f"max_gaussians: expected min_gaussians ({cfg.min_gaussians}) or more, got "
                    f"{cfg.max_gaussians}"
                )
            number = is_whole(cfg.budget) and cfg.budget >= cfg.min_gaussians
            if not (number or cfg.budget in (None, AUTO)):
                raise UserError(
                    "budget: expected none, auto or a number from min_gaussians "
                    f"({cfg.min_gaussians}) on, got {shown(cfg.budget)}"
                )

    cfg: Config
    SECTION = "system.geometry."

    def configure(self) -> None:
        self.bands = (self.cfg.sh_degree + 1) ** 2
        self._allocate(0)

    # -- size --------------------------------------------------------------------------------------

    def __len__(self) -> int:
        return len(self.means)

    def update_step(self, epoch: int, global_step: int, on_load_weights: bool = False) -> None:
        """Refuse a cloud that no one has filled, as in another package's system."""
        super().update_step(epoch, global_step, on_load_weights=on_load_weights)
        if not (len(self) or on_load_weights):
            raise UserError(
                "gaussiandreamer-cloud is empty, so that nothing would be trained or drawn: "
                "system_type must be gaussiandreamer-system, whose start fills it from "
                "system.geometry.prior, or resume and weights must name a checkpoint of one"
            )

    def _allocate(self, n: int, device: torch.device | str = "cpu") -> None:
        for name, shape in SHAPES.items():
            shape = (self.bands - 1 if side < 0 else side for side in shape)
            setattr(self, name, nn.Parameter(torch.zeros(n, *shape, device=device)))
        for name in STATISTICS:
            self.register_buffer(name, torch.zeros(n, device=device))
        for name, start in AUTO_STATE.items():
            self.register_buffer(name, torch.tensor(start, dtype=torch.float64, device=device))

    def _load_from_state_dict(
        self, state_dict: dict[str, Tensor], prefix: str, *args: Any, **kwargs: Any
    ) -> None:
        """Take the size from the checkpoint before its tensors are copied in."""
        means = state_dict.get(prefix + "means")
        # otherwise torch reports the invalid entry
        if isinstance(means, Tensor) and means.dim() and len(means) != len(self):
            self._allocate(len(means), self.means.device)
        if means is not None:
            if len(self):
                require_cloud(state_dict, {name: prefix + name for name in SHAPES}, "the state")
            # older checkpoints have none of these
            state_dict.setdefault(prefix + "removal", torch.zeros(len(self)))
            for name, start in AUTO_STATE.items():
                state_dict.setdefault(prefix + name, torch.tensor(start))
        super()._load_from_state_dict(state_dict, prefix, *args, **kwargs)

    # -- derived quantities ------------------------------------------------------------------------

    def scales(self) -> Float[Tensor, "N 3"]:
        """Compute standard deviations, world units; clamped where exp would leave float32."""
        return self.log_scales.clamp(*LOG_SCALE_RANGE).exp()

    def opacities(self) -> Float[Tensor, " N"]:
        return torch.sigmoid(self.logit_opacities)

    def drawn(self) -> dict[str, Tensor]:
        """Return what regularisers see, as it is drawn."""
        scales, opacities = self.scales(), self.opacities()
        return dict(means=self.means, quats=self.quats, scales=scales, opacities=opacities)

    @property
    def sh(self) -> Float[Tensor, "N K 3"]:
        """All bands of the spherical harmonics."""
        return torch.cat([self.sh0, self.sh_rest], 1)

    def colors(
        self, camera_positions: Float[Tensor, "B 3"]
    ) -> Float[Tensor, "N 3"] | Float[Tensor, "B N 3"]:
        """Compute RGB in [0, 1], or just not negative without ``bound_colors``; per view when the
        spherical harmonics have more than the constant band.
        """
        if self.bands == 1:
            colors = sh.sh0_to_rgb(self.sh0.squeeze(1))
        else:
            dirs = self.means.detach()[None] - camera_positions[:, None]
            dirs = nn.functional.normalize(dirs, dim=-1)
            colors = sh.sh_to_unclamped_colors(self.sh, dirs)
        return sh.bounded_colors(colors) if self.cfg.bound_colors else colors.clamp_min(0.0)

    @torch.no_grad()
    def clamp_colors(self) -> None:
        """Clamp the constant band to colours in [0, 1], unless ``bound_colors`` is off."""
        if self.cfg.bound_colors:
            self.sh0.clamp_(*(sh.rgb_to_sh0(bound) for bound in (0.0, 1.0)))

    # -- start -------------------------------------------------------------------------------------

    def prior(self) -> Any:
        """Build the prior; raise UserError if the part isn't called with a prompt."""
        part = find(self.cfg.prior_type)
        require_method(part, "__call__", "prompt")
        return part(self.cfg.prior)

    def initialize(self, prompt: str, make_cloud: Any = None) -> PointCloud:
        """Run the prior, grow and perturb its points, and start one Gaussian on each; return the
        prior's points. ``make_cloud(prior, prompt)``, if given, stands in for ``prior(prompt)``.
        """
        prior = self.prior()
        if self.cfg.keep_attributes and hasattr(prior, "gaussians"):
            arrays = prior.gaussians(prompt)
            trained = self._most_visible(arrays.tensors())
            if trained.sh[:, self.bands :].any():
                logger.warning(
                    "the prior's colours depend on the view, with spherical harmonics of degree "
                    "%d: system.geometry.sh_degree=%d drops the bands above; set it to %d to keep "
                    "them",
                    trained.sh_degree, self.cfg.sh_degree, trained.sh_degree,
                )  # fmt: skip
            self.set_arrays(**trained._asdict())
            cloud = prior.cloud(arrays)
        else:
            cloud = make_cloud(prior, prompt) if make_cloud else prior(prompt)
            ground = prior.ground_count() if hasattr(prior, "ground_count") else 0
            self.start_from(grow_points(cloud, self.cfg.grow, ground))
        start = len(self)
        if self.cfg.budget is not None:
            self.merge_duplicates()
        self.started_with.fill_(start)
        return cloud

    def _most_visible(self, cloud: Gaussians) -> Gaussians:
        """Select at most ``max_gaussians``: those that contribute most to views from around."""
        count, most = len(cloud.means), self.cfg.max_gaussians
        if count <= most:
            return cloud
        said = "the prior has %d Gaussians; keeping the %d that contribute most (max_gaussians)"
        logger.warning(said, count, most)
        cloud = cloud.tensors(self.means.device)
        return keep_best(cloud, view_importance(cloud, views_around(cloud, *CAP_VIEWS)), most)

    def merge_duplicates(self) -> None:
        """Merge groups of near-identical Gaussians, until the budget is met or none are left."""
        merged = merge_duplicates(self.parameters_by_name(), at_least=min_count(self.cfg))
        if fewer := len(self) - len(merged["means"]):
            logger.info("%d of %d Gaussians are duplicates of others: merged", fewer, len(self))
            self.set_arrays(sh=torch.cat([merged.pop("sh0"), merged.pop("sh_rest")], 1), **merged)

    def start_from(self, cloud: PointCloud) -> None:
        """Start with one Gaussian on each point."""
        self.set_arrays(**gaussians_on_points(cloud, self.cfg)._asdict())

    def set_arrays(self, *, sh: Any, **arrays: Any) -> None:
        """Replace the cloud, with harmonics ``sh`` (N, K', 3) padded or cut to ``sh_degree``."""
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

    def parameters_by_name(self) -> dict[str, nn.Parameter]:
        return {name: getattr(self, name) for name in PARAMETERS}

    # -- optimisation ------------------------------------------------------------------------------

    def parameter_groups(self) -> list[dict[str, Any]]:
        """Return one optimiser group per attribute, named after it, without learning rates."""
        return [
            {"params": [parameter], "name": name, "lr": 0.0}
            for name, parameter in self.parameters_by_name().items()
            if parameter.numel() or name != "sh_rest"
        ]

    def set_learning_rates(self, optimizer: torch.optim.Optimizer, epoch: int, step: int) -> None:
        for group in optimizer.param_groups:
            if group.get("name") in LEARNING_RATES:
                group["lr"] = C(getattr(self.cfg, LEARNING_RATES[group["name"]]), epoch, step)

    def steps_by_size(self) -> contextlib.AbstractContextManager[None]:
        """Let the optimiser see the means in standard deviations, if their rate has that unit."""
        if self.cfg.lr_means_unit != "size" or self.means.grad is None:
            return contextlib.nullcontext()
        return densify.steps_by_size(self.means, self.scales(), self.quats)

    @property
    def wants_absgrad(self) -> bool:
        """Whether densification reads absolute gradients, which the rasteriser then collects."""
        return self.cfg.densify.enabled and self.cfg.densify.absgrad

    def apply_change(self, change: Change, optimizer: torch.optim.Optimizer) -> None:
        """Apply ``change`` to the cloud and to the rows of the optimiser's state, and reset the
        statistics; raise UserError if no Gaussian is left, or parents and values don't fit.
        """
        rows, count, old = change.parents, len(change.parents), self.parameters_by_name()
        if not count:
            raise UserError("the change of the cloud leaves no Gaussian: keep some, or all")
        if rows.is_floating_point() or not 0 <= int(rows.min()) <= int(rows.max()) < len(self):
            raise UserError(
                f"parents of the change of the cloud: expected {count} integers from 0 to "
                f"{len(self) - 1}, the rows of the Gaussians that they come from"
            )
        shapes = {name: (count, *parameter.shape[1:]) for name, parameter in old.items()}
        found = {name: tuple(value.shape) for name, value in change.values.items()}
        if found != shapes:
            raise UserError(f"the change of the cloud has the shapes {found}; expected {shapes}")
        new = {name: nn.Parameter(value) for name, value in change.values.items()}
        densify.update_optimizer(optimizer, old, new, change)
        for name, parameter in new.items():
            setattr(self, name, parameter)
        for name in STATISTICS:
            self.register_buffer(name, torch.zeros(count, device=self.means.device))
        self.error.zero_()


def grow_points(cloud: PointCloud, cfg: GrowConfig, ground: int = 0) -> PointCloud:
    """Grow points and perturb their colours (the paper's Algorithm 1), within ``max_points``;
    the last ``ground`` points, a prior's ground, neither grow nor count for the box, and stay last.
    """
    if not cfg.enabled:
        return cloud
    if ground:
        figure, layer = cloud.split(len(cloud.points) - ground)
        return grow_points(figure, cfg).followed_by(layer)
    options = {k: v for k, v in vars(cfg).items() if k not in ("enabled", "color_range")}
    rng = numpy_generator(run_seed(), "grow")
    return grow(cloud, color_range=tuple(cfg.color_range), **options, generator=rng)


def gaussians_on_points(cloud: PointCloud, cfg: Any) -> Gaussians:
    """Make one Gaussian of each point: its colour, opacity ``init_opacity``, an isotropic scale
    from the nearest distances.

    Args:
        cfg: the geometry's, for ``scale_rule``, ``scale_factor``, ``init_opacity`` and
            ``max_gaussians``. Of more points a uniform choice is kept: all have the same opacity,
            so that selecting by contribution to renders would prefer outer ones and leave holes.
    """
    points, colors, most = cloud.points, cloud.colors, cfg.max_gaussians
    if len(points) > most:
        said = "the prior and its growth give %d points; keeping %d, evenly (max_gaussians)"
        logger.warning(said, len(points), most)
        rng = numpy_generator(run_seed(), "cap")
        rows = np.sort(rng.choice(len(points), most, replace=False))
        points, colors = points[rows], colors[rows]
    scales = nearest_distance_scales(points, cfg.scale_rule) * cfg.scale_factor
    colors = torch.from_numpy(np.ascontiguousarray(colors, np.float32))
    return Gaussians(
        means=points,
        quats=np.tile(np.float32([1, 0, 0, 0]), (len(points), 1)),
        log_scales=np.repeat(np.log(scales)[:, None], 3, 1),
        logit_opacities=np.full(len(points), math.log(cfg.init_opacity / (1 - cfg.init_opacity))),
        sh=sh.rgb_to_sh0(colors).numpy()[:, None],
    )
