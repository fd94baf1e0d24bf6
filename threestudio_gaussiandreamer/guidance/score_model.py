"""Access to a score model: its noise schedule, the timesteps and noise of a step, and predictions
of the noise with classifier-free guidance.

Timesteps and noise are functions of (seed, step, item), so a resumed run draws the same values as
an uninterrupted one. The options are in the table of ``base.py``."""

from abc import ABC, abstractmethod
from dataclasses import dataclass, field
from typing import Any, Optional, Tuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from ..core import streams
from ..core.distributed import first_item
from ..core.errors import UserError
from ..core.host_copies import to_device
from ..core.options import at_least, in_range, interval, one_of, schedule
from ..diffusion import sds
from ..diffusion.noise_prediction import rescaled
from ..diffusion.timesteps import SCHEDULES, scheduled_timestep
from ..host import BaseObject, C, run_seed, warn
from .score_pictures import Noised

GUIDANCE_SCALE = in_range(-1e6, 1e6)


class ScoreModel(BaseObject, ABC):
    """A model that predicts the noise in a noisy latent, with and without its condition."""

    @dataclass
    class Config(BaseObject.Config):
        guidance_scale: float = field(default=100.0, metadata=GUIDANCE_SCALE)
        min_step_percent: Any = field(default=0.02, metadata=schedule(min=0, max=1))
        max_step_percent: Any = field(default=0.98, metadata=schedule(min=0, max=1))
        guidance_interval: Tuple[float, float] = field(
            default=(0.0, 1.0), metadata=interval(0, 1, "shares of all timesteps")
        )
        recon_std_rescale: float = field(default=0.0, metadata=in_range(0, 1))
        timestep_schedule: str = field(default="uniform", metadata=one_of(("uniform", *SCHEDULES)))
        timestep_steps: int = field(default=0, metadata=at_least(0, "steps"))

        @staticmethod
        def check(cfg: Any) -> None:
            for step in _knots(cfg.min_step_percent, cfg.max_step_percent):
                sds.step_range(
                    C(cfg.min_step_percent, step, step), C(cfg.max_step_percent, step, step)
                )
            if cfg.timestep_schedule == "uniform" and cfg.timestep_steps:
                raise UserError(
                    "timestep_steps: timestep_schedule=uniform doesn't use it: choose one of "
                    f"{', '.join(SCHEDULES)}, or set it to 0"
                )
            if cfg.timestep_schedule != "uniform" and not cfg.timestep_steps:
                raise UserError(
                    f"timestep_steps: timestep_schedule={cfg.timestep_schedule} needs the number "
                    "of steps in which timesteps fall, such as '${trainer.max_steps}'"
                )

    cfg: Config
    alphas_cumprod: Float[Tensor, " T"]
    """The noise schedule, float64; a subclass sets it in ``configure``."""
    options: Any
    """Of ``cfg``, as plain attributes."""
    evaluations: int
    """Of the score model, one per item and prompt, since a step began; ``predict`` counts them."""
    prediction_sum: Optional[Float[Tensor, ""]] = None
    """Of all that ``predict`` returned since a step began; None if it wasn't called."""

    def configure(self) -> None:
        self.alphas_cumprod = sds.sd_alphas_cumprod()
        self.evaluations, self._has_warned = 0, False

    def update_step(self, epoch: int, global_step: int, on_load_weights: bool = False) -> None:
        """Evaluate the schedules at this step."""
        self.step = global_step
        options = self.options
        percents = (
            C(percent, epoch, global_step)
            for percent in (options.min_step_percent, options.max_step_percent)
        )
        self.min_step, self.max_step = sds.step_range(*percents, len(self.alphas_cumprod))

    # Predictions
    # ----------------------------------------------------------------------------------------------

    @abstractmethod
    def predict(
        self, z: Float[Tensor, "B c h w"], t: Int[Tensor, " B"], condition: Any
    ) -> tuple[Float[Tensor, "B c h w"], Optional[Float[Tensor, "B c h w"]]]:
        """Predict the noise in z, conditional and unconditional (None if ``guidance_scale`` is 1);
        called without gradients.
        """

    def _predicted(
        self, z: Float[Tensor, "B c h w"], t: Int[Tensor, " B"], condition: Any
    ) -> tuple[Float[Tensor, "B c h w"], Optional[Float[Tensor, "B c h w"]]]:
        """Call ``predict``, and check what it returns: a smaller tensor would be broadcast.

        Raises:
            UserError: it isn't a pair of predictions in the shape of z.
        """
        found = self.predict(z, t, condition)
        entries = found if isinstance(found, (tuple, list)) else [found]
        shapes = [entry.shape if isinstance(entry, Tensor) else type(entry) for entry in entries]
        if entries is not found or shapes not in ([z.shape, z.shape], [z.shape, type(None)]):
            what = " and ".join(
                shape.__name__ if isinstance(shape, type) else str(tuple(shape)) for shape in shapes
            )
            raise UserError(
                f"{type(self).__name__}.predict returned {'' if entries is found else 'only '}"
                f"{what}; expected a pair, the conditional and the unconditional prediction (or "
                f"None), of the shape {tuple(z.shape)} of the noisy latents"
            )
        # a sum isn't finite if an entry isn't; read only if the error turns out not to be finite
        sums = sum(entry.detach().float().sum() for entry in found if entry is not None)
        self.prediction_sum = sums if self.prediction_sum is None else self.prediction_sum + sums
        return found

    def select(self, condition: Any, rows: Int[Tensor, " R"]) -> Any:
        """Return the conditions of some items. Conditions that are None, a tensor or a list with
        one entry per item are known; subclasses with others override this.

        Raises:
            UserError: the condition is of another type.
        """
        if isinstance(condition, list):
            return [condition[row] for row in rows.tolist()]
        if condition is None or isinstance(condition, Tensor):
            return condition if condition is None else condition[rows]
        raise UserError(
            f"{type(self).__name__} has conditions of type {type(condition).__name__}: define its "
            f"method select, which guidance_interval and {self.cfg.variant_type} need"
        )

    def predict_noise(
        self, z: Float[Tensor, "B c h w"], t: Int[Tensor, " B"], condition: Any
    ) -> Float[Tensor, "B c h w"]:
        """Predict the noise with guidance: that of ``guidance_scale`` for items inside of
        ``guidance_interval``, none for others.
        """
        low, high = (share * len(self.alphas_cumprod) for share in self.options.guidance_interval)
        if low == 0 and high == len(self.alphas_cumprod):
            return self._with_guidance(z, t, condition)
        inside = (t >= low) & (t <= high)
        if inside.all():
            return self._with_guidance(z, t, condition)
        eps = torch.empty_like(z)
        for mask, predict in ((inside, self._with_guidance), (~inside, self.conditional)):
            if mask.any():
                rows = mask.nonzero()[:, 0]
                eps[rows] = predict(z[rows], t[rows], self.select(condition, rows))
        return eps

    def _with_guidance(self, z: Tensor, t: Tensor, condition: Any) -> Tensor:
        return self.guided_noise(
            z, t, condition, self.options.guidance_scale, rescale=self.options.recon_std_rescale
        )

    def guided_noise(
        self,
        z: Float[Tensor, "B c h w"],
        t: Int[Tensor, " B"],
        condition: Any,
        scale: float,
        *,
        rescale: float = 0.0,
    ) -> Float[Tensor, "B c h w"]:
        """Predict the noise with classifier-free guidance.

        Args:
            scale: 1 for no guidance.
            rescale: see ``recon_std_rescale``.
        """
        if scale == 1:
            return self._predicted(z, t, condition)[0].to(z)
        cond, uncond = self.both(z, t, condition)
        if uncond is cond and not self._has_warned:
            self._has_warned = True
            warn(
                f"guidance_scale={scale:g} has no effect: {type(self).__name__}.predict returns no "
                "unconditional prediction"
            )
        guided = sds.classifier_free(cond, uncond, scale)
        return rescaled(guided, cond, z, self.abar_of(t), rescale) if rescale else guided

    def both(
        self, z: Float[Tensor, "B c h w"], t: Int[Tensor, " B"], condition: Any
    ) -> tuple[Float[Tensor, "B c h w"], Float[Tensor, "B c h w"]]:
        """Predict the noise, conditional and unconditional; the same if the score model has only
        one.
        """
        cond, uncond = self._predicted(z, t, condition)
        cond = cond.to(z)
        return cond, cond if uncond is None else uncond.to(z)

    def conditional(
        self, z: Float[Tensor, "B c h w"], t: Int[Tensor, " B"], condition: Any
    ) -> Float[Tensor, "B c h w"]:
        """Predict the conditional noise alone; subclasses that can save time here override it."""
        return self._predicted(z, t, condition)[0].to(z)

    def unconditional(
        self, z: Float[Tensor, "B c h w"], t: Int[Tensor, " B"], condition: Any
    ) -> Float[Tensor, "B c h w"]:
        """Predict the unconditional noise alone; subclasses that can save time here override it."""
        return self.both(z, t, condition)[1]

    def empty_prompt(
        self, z: Float[Tensor, "B c h w"], t: Int[Tensor, " B"], condition: Any
    ) -> Optional[Float[Tensor, "B c h w"]]:
        """Predict the noise for an empty prompt, where the unconditional score is that of a
        negative prompt; None where the unconditional score is all there is.
        """
        return None

    # The noise of a step
    # ----------------------------------------------------------------------------------------------

    def abar_of(self, t: Int[Tensor, "*b"]) -> Float[Tensor, "*b"]:
        """Return abar of timesteps, on their device."""
        return self.alphas_cumprod.to(t.device)[t]

    def draw_timesteps(
        self, latents: Float[Tensor, "B c h w"]
    ) -> tuple[Int[Tensor, " B"], Float[Tensor, " B"]]:
        """Draw this step's timesteps t; also return their abar, float64."""
        if self.options.timestep_schedule == "uniform":
            t = sds.timesteps(
                len(latents),
                self.min_step,
                self.max_step,
                seed=run_seed(),
                step=self.step,
                num_train=len(self.alphas_cumprod),
                first=first_item(len(latents)),
            )
        else:
            t = torch.full((len(latents),), self._scheduled_timestep())
        abar = self.alphas_cumprod.double().cpu()[t]
        return to_device(t, latents.device), to_device(abar, latents.device)

    def _scheduled_timestep(self) -> int:
        limits = (self.min_step, self.max_step)
        return scheduled_timestep(
            self.cfg.timestep_schedule,
            self.step,
            self.cfg.timestep_steps,
            *limits,
            self.alphas_cumprod,
        )

    @torch.no_grad()
    def add_noise(self, latents: Float[Tensor, "B c h w"]) -> Noised:
        """Draw this step's timesteps and noise, and add the noise to ``latents``."""
        return self.noised(latents, self.normal(latents, "noise"))

    def noised(self, latents: Float[Tensor, "B c h w"], noise: Float[Tensor, "B c h w"]) -> Noised:
        """Add a given noise to ``latents`` at this step's timesteps."""
        t, abar = self.draw_timesteps(latents)
        return Noised(t, abar, noise, sds.add_noise(latents, noise, abar))

    def normal(
        self, like: Float[Tensor, "B *d"], stream: str, rows: Optional[Int[Tensor, " R"]] = None
    ) -> Tensor:
        """Draw this step's standard normal numbers, of the shape and on the device of ``like``.

        Args:
            rows: the items to draw for; by default all.
        """
        shape, first = tuple(like.shape), first_item(len(like))
        place = run_seed(), stream, self.step, like.device
        if rows is None:
            return streams.normal_per_item(shape, *place, first)
        one = (1, *shape[1:])
        draws = [streams.normal_per_item(one, *place, first + row) for row in rows.tolist()]
        return torch.cat(draws)


def _knots(*schedules: Any) -> set[int]:
    """Return a set that contains all steps at which the slope of a schedule changes. It also has
    the values of the schedules, which does no harm.
    """
    return {
        0,
        *(
            int(entry)
            for schedule in schedules
            if not isinstance(schedule, (int, float))
            for entry in schedule
        ),
    }
