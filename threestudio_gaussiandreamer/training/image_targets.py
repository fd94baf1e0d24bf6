"""A stage of training towards pictures that the 2D model draws of a few views.

Score distillation averages over noise and views. What a prompt asks for without saying where, such
as dots, has another place in each prediction, and is lost in the average. In this stage the cloud
is rendered from a few views that hardly overlap, each render becomes a picture of the 2D model
(``guidance/image_to_image.py``), and the renders are trained towards these pictures. They decide
where details are; score distillation with small timesteps then makes all other views agree.

===================  ===============================================================================
option               meaning
===================  ===============================================================================
start, stop          first step of the stage, and the one after its last; no stage if ``stop`` is 0
views                cameras, evenly spaced around the object from the front on; all in each step
elevation_deg,       of these cameras: degrees, world units, and the vertical field of view in
camera_distance,     degrees
fovy_deg
strength             the timestep that renders are noised to, as a share of all
num_inference_steps  of DDIM, for each picture
guidance_scale       for each picture; a guidance whose own scale is 1 has no other
colors_only          train only colours in the stage, since the pictures' shapes differ slightly
weight               of the loss, half the squared error of a view's pixels, summed; renders that
                     are larger than the model's pictures are shrunk for it
===================  ===============================================================================

The pictures are drawn in the stage's first step, and are in its checkpoints. Steps of the stage
have the loss ``loss_image_targets`` in place of the guidance's; regularisers of the renders and
density control go on. A random background stays that of the stage's first step. Several processes
train towards the same pictures, each with all views."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Optional

import torch
from jaxtyping import Float
from torch import Tensor, nn

from ..cameras import Orbit
from ..core.distributed import from_first
from ..core.errors import UserError
from ..core.options import at_least, between, in_range, positive
from ..guidance.base import GUIDANCE_SCALE, NonFiniteScore, ScoreDistillation
from ..guidance.image_to_image import image_to_image
from ..guidance.known_truth import resized
from ..host import find, info, parse_structured
from .background import FlatBackground
from .data import orbit_batch
from .geometry import LEARNING_RATES
from .losses import REGULARISERS

NAME = "image_targets"
"""Of the loss."""
SHAPES = tuple(name for name in LEARNING_RATES if not name.startswith("sh"))
"""The optimiser's groups that aren't colours."""


@dataclass
class ImageTargetsConfig:
    start: int = field(default=0, metadata=at_least(0))
    stop: int = field(default=0, metadata=at_least(0, "steps; 0: no stage"))
    views: int = field(default=4, metadata=in_range(1, 1000))
    elevation_deg: float = field(default=15.0, metadata=in_range(-90, 90, "degrees"))
    camera_distance: float = field(default=2.5, metadata=positive("world units"))
    fovy_deg: float = field(default=45.0, metadata=between(0, 180, "degrees"))
    strength: float = field(default=0.7, metadata=in_range(0, 1))
    num_inference_steps: int = field(default=8, metadata=in_range(1, 1000))
    guidance_scale: float = field(default=7.5, metadata=GUIDANCE_SCALE)
    colors_only: bool = True
    weight: float = field(default=1.0, metadata=positive())

    @staticmethod
    def check(cfg: Any) -> None:
        if cfg.stop and cfg.start >= cfg.stop:
            raise UserError(f"stop: expected more than start ({cfg.start}), got {cfg.stop}")


def check_image_targets(cfg: Any) -> None:
    """Check that the guidance can draw the pictures of the stage, if there is one.

    Args:
        cfg: the system's options.

    Raises:
        UserError: it isn't one of this package, or sees another number of views together.
    """
    if not cfg.image_targets.stop:
        return
    guidance = find(cfg.guidance_type)
    if not issubclass(guidance, ScoreDistillation):
        raise UserError(
            f"image_targets.stop: {cfg.guidance_type} can't draw pictures: use a guidance of this "
            "package, or 0 for no such stage"
        )
    together = getattr(parse_structured(guidance.Config, cfg.guidance), "n_view", None)
    if together not in (None, cfg.image_targets.views):
        raise UserError(
            f"image_targets.views: expected {together}, the number of views that this guidance "
            f"sees together, got {cfg.image_targets.views}"
        )


class ImageTargets(nn.Module):
    """The stage; a module, so that checkpoints have its pictures."""

    pictures: Optional[Float[Tensor, "V H W 3"]]
    """None before the stage; dropped in the first step after it."""

    def __init__(self, cfg: ImageTargetsConfig) -> None:
        super().__init__()
        self.cfg = cfg
        self.register_buffer("pictures", None)

    def is_active(self, step: int) -> bool:
        """Return whether a step belongs to the stage."""
        return self.cfg.start <= step < self.cfg.stop

    def batch(self, batch: dict[str, Any], step: int, background: Any = None) -> dict[str, Any]:
        """Return the batch of a step: within the stage that of its own cameras, else ``batch``.

        Args:
            background: if it is random, its colour stays that of the stage's first step.
        """
        if not self.is_active(step):
            if self.pictures is not None:
                self.pictures = None
            return batch
        if isinstance(background, FlatBackground):
            background.hold(self.cfg.start)
        own, device = orbit_batch(self.orbit, batch["height"], batch["width"]), batch["c2w"].device
        return {name: v.to(device) if torch.is_tensor(v) else v for name, v in own.items()}

    @property
    def orbit(self) -> Orbit:
        """The stage's cameras."""
        azimuth, cfg = torch.arange(self.cfg.views) * 360.0 / self.cfg.views, self.cfg
        angles = cfg.elevation_deg, cfg.camera_distance, math.radians(cfg.fovy_deg)
        elevation, distance, fovy = (torch.full_like(azimuth, value) for value in angles)
        return Orbit(elevation, (azimuth + 180) % 360 - 180, distance, fovy)

    def guide(
        self,
        guidance: ScoreDistillation,
        out: Mapping[str, Any],
        prompt_utils: Any,
        batch: dict[str, Any],
    ) -> dict[str, Any]:
        """Return the loss of the renders of :meth:`batch`, and the score model's evaluations.

        Args:
            out: the renderer's output.
        """
        guidance.evaluations, rgb = 0, out["comp_rgb"].float()
        if self.pictures is None or len(self.pictures) != len(rgb):  # drawn with other options
            batch = {**batch, "comp_rgb_bg": out["comp_rgb_bg"].detach()}
            self.pictures = from_first(
                lambda: self.draw(guidance, rgb.detach(), prompt_utils, batch).cpu()
            ).to(rgb.device)
        targets = self.pictures.to(rgb.device)  # a checkpoint's are on the CPU
        renders = resized(rgb.movedim(-1, 1), tuple(targets.shape[1:3])).movedim(1, -1)
        error = (renders - targets).square().sum()
        evaluations = {"evaluations": float(guidance.evaluations)}
        return {f"loss_{NAME}": 0.5 * error / len(rgb), **evaluations}

    def draw(
        self,
        guidance: ScoreDistillation,
        rgb: Float[Tensor, "V H W 3"],
        prompt_utils: Any,
        batch: dict[str, Any],
    ) -> Float[Tensor, "V h w 3"]:
        """Draw the pictures.

        Raises:
            NonFiniteScore: a picture has NaN or infinity.
        """
        names = ("strength", "num_inference_steps", "guidance_scale")
        how = {name: getattr(self.cfg, name) for name in names}
        pictures = image_to_image(guidance, rgb, prompt_utils, **how, **batch)
        if not pictures.isfinite().all():
            raise NonFiniteScore(
                f"the 2D model's pictures for image_targets (step {guidance.step}) aren't finite: "
                "use full precision (system.guidance.half_precision_weights=false)"
            )
        info(f"step {guidance.step}: training towards {len(pictures)} pictures of the 2D model")
        return pictures

    def hold_shapes(self, optimizer: torch.optim.Optimizer, step: int) -> None:
        """Drop the gradients of all but the colours in steps of a stage with ``colors_only``, so
        that the optimiser changes neither these parameters nor their moments.
        """
        if self.cfg.colors_only and self.is_active(step):
            for group in optimizer.param_groups:
                if group.get("name") in SHAPES:
                    for parameter in group["params"]:
                        parameter.grad = None

    def schedule_problem(self, start: int, stop: int) -> Optional[str]:
        """Return what is wrong with the stage in a run of the steps [start, stop); None if nothing
        is.
        """
        if stop < 0 or start >= self.cfg.stop or self.cfg.stop <= stop:
            return None
        return (
            f"the stage image_targets, steps {self.cfg.start} to {self.cfg.stop}, isn't over at "
            f"step {stop}, the last: set system.image_targets.start and stop accordingly"
        )

    def loss_weights(self, weights: dict[str, float], step: int) -> dict[str, float]:
        """Return the weights of a step's losses.

        Args:
            weights: those of the losses of the guidance and of the regularisers.
        """
        if not self.is_active(step):
            return weights
        kept = {name: weight for name, weight in weights.items() if name in REGULARISERS}
        return kept | {NAME: self.cfg.weight}

    def _load_from_state_dict(
        self, state_dict: dict[str, Tensor], prefix: str, *args: Any, **kwargs: Any
    ) -> None:
        """Make room for the checkpoint's pictures, if it has any."""
        pictures = state_dict.get(f"{prefix}pictures")
        self.pictures = torch.empty_like(pictures) if isinstance(pictures, Tensor) else None
        super()._load_from_state_dict(state_dict, prefix, *args, **kwargs)
