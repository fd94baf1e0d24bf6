"""Score distillation: the computation that all guidances share, from a render to the gradient of
its latent.

    x = encode(render),  z = sqrt(abar) x + sqrt(1 - abar) eps,  grad = w(t) (eps_hat(z, t) - eps),
                         dloss/dx = grad / B

A variant (``variants/``) replaces eps_hat - eps by another error, for every guidance alike. A
guidance is a subclass that says how to ``encode`` and ``decode``, what to ``condition`` on, and
how to ``predict`` the noise. Its networks may run in half precision; this module computes in
float32. Timesteps and noise are functions of (seed, step, item), so a resumed run draws the same
values as an uninterrupted one.

==================  ================================================================================
option              meaning
==================  ================================================================================
guidance_scale      eps = eps_u + scale (eps_c - eps_u); 1 = none. threestudio's scale is one less:
                    its 100 is 101 here
guidance_interval   [low, high], shares of all timesteps: only between them the unconditional score
                    is computed and the scale applied (Kynkaanniemi et al. 2024)
recon_std_rescale   0 to 1: bring the contrast of the guided x0 back to that of the conditional one
                    (Lin et al. 2023, as in MVDream), which undoes the over-exposure of large scales
variant_type        how the score becomes a gradient, and the options of it: sds-variant,
variant             csd-variant, ...; see docs/distillation.md
min_step_percent    smallest timestep as a share of all, a number or a schedule; timesteps are
                    clamped to [1, T - 1]
max_step_percent    largest timestep, likewise (the paper: [500, 0.98, 0.55, 501])
timestep_schedule   uniform: random between the two; linear, sqrt, dreamtime: from the largest to
                    the smallest within ``timestep_steps`` steps, the same for all items. One fixed
                    timestep: the same share as the smallest and as the largest
grad_clip           clamp each element of the latent's gradient to +- this; none, a number or a
                    schedule
weighting_strategy  w(t): sds (1 - abar), uniform (1), fantasia3d (sqrt(abar) (1 - abar)),
                    x0 (sqrt((1 - abar) / abar): the gradient is x minus the denoised x),
                    rectified_flow (1 + sqrt((1 - abar) / abar): the error of a flow's velocity)
reuse_steps         steps of the same views that one prediction serves, see ``reuse.py``
max_bad_steps       stop after this many steps in a row in which the score of some item was NaN or
                    infinite
max_items_eval      how many items ``guidance_eval`` shows; 0 or less = all, as in threestudio
eval_steps          DDIM steps from the noise to ``imgs_final``
==================  ================================================================================
"""

import functools
from abc import abstractmethod
from dataclasses import dataclass, field
from typing import Any, Optional

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ..core.devices import without_autocast
from ..core.errors import UserError, unknown
from ..core.host_copies import DelayedReads
from ..core.methods import require_method
from ..core.options import at_least, checked_options, in_range, one_of, schedule
from ..diffusion import sds
from ..host import C, find, names, parse_structured, warn
from .non_finite import find_bad_items, masked_loss, may_have_any, without_bad_items
from .particles import GaussianParticles, ParticleModel
from .reuse import Error, KeptPrediction
from .score_model import GUIDANCE_SCALE, ScoreModel
from .score_pictures import score_pictures
from .variants import Variant
from .variants.base import checked_error, require_unset

__all__ = ["GUIDANCE_SCALE", "NonFiniteScore", "ScoreDistillation"]


class NonFiniteScore(UserError):
    """The score model returned NaN or infinity in ``max_bad_steps`` consecutive steps."""


class ScoreDistillation(ScoreModel):
    """Base class of all guidances; see the module's docstring."""

    @dataclass
    class Config(ScoreModel.Config):
        variant_type: str = "sds-variant"
        variant: dict = field(default_factory=dict)
        grad_clip: Any = field(default=None, metadata=schedule(min=0))
        weighting_strategy: str = field(default="sds", metadata=one_of(sds.WEIGHTS))
        reuse_steps: int = field(default=1, metadata=in_range(1, 1000, "steps"))
        max_bad_steps: int = field(default=10, metadata=at_least(1))
        max_items_eval: int = 4
        eval_steps: int = field(default=20, metadata=in_range(1, 1000))

        @staticmethod
        def check(cfg: Any) -> None:
            ScoreModel.Config.check(cfg)
            variant_class(cfg)

    cfg: Config

    # Defined by subclasses
    # ----------------------------------------------------------------------------------------------

    @abstractmethod
    def encode(self, rgb: Float[Tensor, "B 3 H W"], **batch: Any) -> Float[Tensor, "B c h w"]:
        """Encode images in [0, 1], differentiably."""

    @abstractmethod
    def decode(self, latents: Float[Tensor, "B c h w"]) -> Float[Tensor, "B 3 H W"]:
        """Decode latents to images in [0, 1], for display."""

    @abstractmethod
    def condition(self, prompt_utils: Any, **batch: Any) -> Any:
        """Return the conditions on prompt and views for ``predict``; called without gradients."""

    def particle_model(self, options: Any) -> ParticleModel:
        """Return the model of the renders' own distribution that ``vsd-variant`` trains.

        Args:
            options: the variant's, without effect of those in ``PARTICLES_IGNORE``.
        """
        return GaussianParticles(options.momentum)

    @classmethod
    def check_particle_model(cls, cfg: Any) -> None:
        """Raise UserError if ``vsd-variant`` can't be used with these options of the guidance."""

    @classmethod
    def preflight(cls, cfg: Any) -> None:
        """Check within seconds that a guidance of this configuration can be built; called before
        any long work.

        Raises:
            UserError: a requirement, such as a model's file, is missing; the message says what to
                do.
        """
        cfg = parse_structured(cls.Config, cfg)
        variant_class(cfg).preflight(cls, cfg)
        if cfg.guidance_scale == 1:
            require_unset(cls, cfg, cls.UNGUIDED_IGNORES, "with guidance_scale=1, no guidance")

    @classmethod
    def is_text_guided(cls, cfg: Any) -> bool:
        """Return whether the conditional score differs from the unconditional one."""
        return True

    REPORTS: tuple[str, ...] = ()
    """The keys of :meth:`report`, which ``checkpoint.monitor`` may name."""

    UNGUIDED_IGNORES: tuple[str, ...] = ("guidance_interval", "recon_std_rescale")
    """Options that have no effect if ``guidance_scale`` is 1."""

    PARTICLES_IGNORE: tuple[str, ...] = ("rank", "lr", "samples", "camera_dropout")
    """Options of ``vsd-variant`` that :meth:`particle_model` doesn't read."""

    LOSSES: tuple[str, ...] = ("sds",)
    """Names of the losses that a step returns, without the prefix ``loss_``."""

    KNOWS_TRUTH = False
    """Whether instances have an attribute ``truth``, see :mod:`.known_truth`."""

    def report(self) -> dict[str, float]:
        """Return further numbers about the last step, to be logged."""
        return {}

    # The shared computation
    # ----------------------------------------------------------------------------------------------

    def configure(self) -> None:
        self.options = checked_options(self.Config, self.cfg, "system.guidance.")
        super().configure()
        self.variant = variant_class(self.cfg)(self.cfg.variant)
        self._kept = KeptPrediction(self.options.reuse_steps)
        self.bad_items = self.bad_steps = 0
        self.reads = DelayedReads()
        self.update_step(0, 0)

    @property
    def renders(self) -> tuple[str, ...]:
        """Names of the renderer's outputs that the batch must have beside ``comp_rgb_bg``."""
        return self.variant.RENDERS

    @property
    def guided(self) -> bool:
        """Whether ``predict`` returns the unconditional score too: for classifier-free guidance, or
        since the variant needs it.
        """
        return is_guided(self.options, self.variant)

    def update_step(self, epoch: int, global_step: int, on_load_weights: bool = False) -> None:
        """Evaluate the schedules at this step."""
        super().update_step(epoch, global_step)
        clip = self.options.grad_clip
        self.grad_clip = None if clip is None else C(clip, epoch, global_step)

    def __call__(
        self,
        rgb: Float[Tensor, "B H W c"],
        prompt_utils: Any = None,
        *,
        rgb_as_latents: bool = False,
        guidance_eval: bool = False,
        **batch: Any,
    ) -> dict[str, Any]:
        """Return the loss whose gradient is the score distillation gradient, and values to log.

        Args:
            rgb: renders in [0, 1]; or latents, with ``rgb_as_latents``.
            guidance_eval: also return ``eval``, see :mod:`.score_pictures`.
            batch: the host's batch, and ``comp_rgb_bg``.

        Returns:
            ``loss_sds``; ``grad_norm`` of the batch, and ``grad_norm_0``, ... of each item;
            ``min_step``, ``max_step``; ``bad_items``, the number of items whose score isn't finite;
            ``evaluations``, those of the score model in this step, one per item and prompt; the
            entries of :meth:`report`; and ``eval``, if requested.

        Raises:
            NonFiniteScore: in each of the last ``max_bad_steps`` steps the score of at least one
                item wasn't finite. On a GPU it is raised when that is known, which may be in a
                later step, also in its backward pass.
        """
        self.evaluations, self.prediction_sum = 0, None
        with without_autocast(rgb.device.type):
            images = rgb.float().movedim(-1, 1).contiguous()
            latents = (images if rgb_as_latents else self.encode(images, **batch)).float()
            with torch.no_grad():
                condition = self.condition(prompt_utils, **batch)
                error, fresh = self._error(latents, condition, batch, guidance_eval)
                grad, bad = self._gradient(*error)
            if not guidance_eval:  # an evaluation isn't a training step
                self._count_bad(bad)
                if fresh:
                    self.variant.learn(self, latents.detach(), condition, batch, ~bad)
            loss = masked_loss(images, latents, grad, bad)
            norms = torch.linalg.vector_norm(grad.flatten(1), dim=1)
            out = self._result(loss, norms, bad.sum().float())
            if guidance_eval:
                out["eval"] = score_pictures(self, self.add_noise(latents), prompt_utils, batch)
        return out

    def _result(
        self, loss: Float[Tensor, ""], norms: Float[Tensor, " B"], bad_items: Float[Tensor, ""]
    ) -> dict[str, Any]:
        """Return the loss and what is logged, from the norm of the gradient of each item and the
        number of bad items.
        """
        out = {
            "loss_sds": loss,
            "grad_norm": torch.linalg.vector_norm(norms),
            "min_step": self.min_step,
            "max_step": self.max_step,
        }
        out |= {f"grad_norm_{i}": norm for i, norm in enumerate(norms.unbind(0))}
        out |= {"bad_items": bad_items, "evaluations": float(self.evaluations)}
        return out | _reported(self) | _reported(self.variant)

    def _error(
        self,
        latents: Float[Tensor, "B c h w"],
        condition: Any,
        batch: dict[str, Any],
        guidance_eval: bool,
    ) -> tuple[Error, bool]:
        """Compute the variant's error; also return whether it is that of a new prediction."""

        def predict() -> Error:
            found = self.variant.error(self, latents, condition, batch)
            return checked_error(self.variant, found, latents)

        if guidance_eval:
            return predict(), True
        return self._kept.error(self.step, latents, batch, predict)

    def state(self) -> dict[str, Tensor]:
        """Return the tensors that a checkpoint needs to resume; empty for most configurations."""
        return self.variant.state() | self._kept.state()

    def restore(self, state: dict[str, Tensor]) -> None:
        """Restore what :meth:`state` returned.

        Raises:
            UserError: the tensors aren't those of this configuration.
        """
        self.variant.restore(self, self._kept.restore(state, self.device))

    def known_error(
        self, latents: Float[Tensor, "B c h w"], condition: Any
    ) -> Optional[tuple[Float[Tensor, "B c h w"], Float[Tensor, " B"]]]:
        """Return eps_hat - eps and abar if they don't depend on the noise, which isn't drawn then;
        None if they do.
        """
        return None

    def _gradient(
        self, error: Float[Tensor, "B c h w"], abar: Float[Tensor, " B"]
    ) -> tuple[Tensor, Tensor]:
        """Compute w(t) (eps_hat - eps), clipped to ``grad_clip``.

        Returns:
            the gradient, zero for items in which it isn't finite, and a mask of those, (B,) bool.
        """
        grad = sds.per_item(sds.weight(self.options.weighting_strategy, abar), error) * error
        bad = find_bad_items(grad)
        if may_have_any(bad):
            grad = without_bad_items(grad, bad)
        return grad if self.grad_clip is None else grad.clamp(-self.grad_clip, self.grad_clip), bad

    def _count_bad(self, bad: Bool[Tensor, " B"]) -> None:
        total = self.prediction_sum
        good_scores = torch.zeros_like(bad[:1]) if total is None else total.isfinite().to(bad)[None]
        self.reads.submit(
            torch.cat([bad, good_scores]), functools.partial(self._note_bad, self.step)
        )

    def _note_bad(self, step: int, found: Bool[Tensor, " B1"]) -> None:
        """Count the bad items of a step; warn of them, or raise NonFiniteScore.

        Args:
            found: the bad items, and whether all predictions of the score model were finite.
        """
        bad, good_scores = found[:-1], bool(found[-1])
        count = int(bad.sum())
        self.bad_items += count
        self.bad_steps = self.bad_steps + 1 if count else 0
        if self.bad_steps >= self.options.max_bad_steps:
            culprit, advice = (
                "the score model",
                (
                    "use full precision (half_precision_weights=false), and check the model and "
                    "the prior"
                ),
            )
            if good_scores:
                culprit = f"{type(self.variant).__name__}.error"
                advice = "the predictions of the score model that it was given are finite"
            raise NonFiniteScore(
                f"{culprit} returned NaN or infinity in {self.bad_steps} steps in a row"
                f" (step {step}, {self.bad_items} items so far): {advice}"
            )
        if count:
            what = f"{type(self.variant).__name__}.error" if good_scores else "the score"
            warn(
                f"step {step}: {what} of {count} of {len(bad)} items isn't finite; "
                "they are left out"
            )


def _reported(part: ScoreModel | Variant) -> dict[str, float]:
    """Return what a guidance or a variant reports.

    Raises:
        UserError: it isn't a dictionary.
    """
    found = part.report()
    if not isinstance(found, dict):
        raise UserError(
            f"{type(part).__name__}.report returned {type(found).__name__}; expected a dictionary "
            "of names and numbers, {} if there is none"
        )
    return found


def is_guided(cfg: Any, variant: Variant | type[Variant]) -> bool:
    """Return whether these options, with this variant, need the unconditional score too."""
    return cfg.guidance_scale != 1 or variant.NEEDS_UNCONDITIONAL


def variant_class(cfg: Any) -> type[Variant]:
    """Return the class that ``variant_type`` names.

    Raises:
        UserError: it is unknown, or another kind of part.
    """
    try:
        found = find(cfg.variant_type)
    except UserError:
        found = None
    if not _is_variant(found):
        known = [name for name in names() if _is_variant(find(name))]
        raise UserError(f"variant_type: {unknown('variant', cfg.variant_type, known)}")
    require_method(found, "error", "guidance", "latents", "condition", "batch")
    return found


def _is_variant(part: Any) -> bool:
    return isinstance(part, type) and issubclass(part, Variant)
