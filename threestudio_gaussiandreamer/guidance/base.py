"""Score distillation: the computation that all guidances share, from a render to the gradient of
its latent.

    x = encode(render),  z = sqrt(abar) x + sqrt(1 - abar) eps,  grad = w(t) (eps_hat(z, t) - eps),
                         dloss/dx = grad / B

A guidance is a subclass that says how to ``encode`` and ``decode``, what to ``condition`` on, and
how to ``predict`` the noise. Its networks may run in half precision; this module computes in
float32. Timesteps and noise are functions of (seed, step, item), so a resumed run draws the same
values as an uninterrupted one.

==================  ================================================================================
option              meaning
==================  ================================================================================
guidance_scale      eps = eps_u + scale (eps_c - eps_u); 1 = none. threestudio's scale is one less:
                    its 100 is 101 here
min_step_percent    smallest timestep as a share of all, a number or a schedule; timesteps are
                    clamped to [1, T - 1]
max_step_percent    largest timestep, likewise (the paper: [500, 0.98, 0.55, 501])
grad_clip           clamp each element of the latent's gradient to +- this; none, a number or a
                    schedule
weighting_strategy  w(t): sds (1 - abar), uniform (1), fantasia3d (sqrt(abar) (1 - abar))
max_bad_steps       stop after this many steps in a row in which the score of some item was NaN or
                    infinite
max_items_eval      how many items ``guidance_eval`` shows; 0 or less = all, as in threestudio
eval_steps          DDIM steps from the noise to ``imgs_final``
==================  ================================================================================
"""

from abc import ABC, abstractmethod
from dataclasses import dataclass, field
from typing import Any, NamedTuple, Optional

import torch
from jaxtyping import Float, Int
from torch import Tensor

from ..core import streams
from ..core.distributed import first_item
from ..core.errors import UserError
from ..core.options import at_least, check_options, in_range, one_of, schedule
from ..diffusion import sds
from ..host import BaseObject, C, run_seed, warn

GUIDANCE_SCALE = in_range(-1e6, 1e6)


class NonFiniteScore(UserError):
    """The score model returned NaN or infinity in ``max_bad_steps`` consecutive steps."""


class Noised(NamedTuple):
    """A batch of noisy latents, the input of the score model."""

    t: Int[Tensor, " B"]
    abar: Float[Tensor, " B"]
    """float64."""
    noise: Float[Tensor, "B c h w"]
    z: Float[Tensor, "B c h w"]


class ScoreDistillation(BaseObject, ABC):
    """Base class of all guidances; see the module's docstring."""

    @dataclass
    class Config(BaseObject.Config):
        guidance_scale: float = field(default=100.0, metadata=GUIDANCE_SCALE)
        min_step_percent: Any = field(default=0.02, metadata=schedule(min=0, max=1))
        max_step_percent: Any = field(default=0.98, metadata=schedule(min=0, max=1))
        grad_clip: Any = field(default=None, metadata=schedule(min=0))
        weighting_strategy: str = field(default="sds", metadata=one_of(sds.WEIGHTS))
        max_bad_steps: int = field(default=10, metadata=at_least(1))
        max_items_eval: int = 4
        eval_steps: int = field(default=20, metadata=in_range(1, 1000))

        @staticmethod
        def check(cfg: Any) -> None:
            for step in _knots(cfg.min_step_percent, cfg.max_step_percent):
                sds.step_range(
                    C(cfg.min_step_percent, step, step), C(cfg.max_step_percent, step, step)
                )

    cfg: Config
    alphas_cumprod: Float[Tensor, " T"]
    """The noise schedule; a subclass sets it in ``configure``."""

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

    @abstractmethod
    def predict(
        self, z: Float[Tensor, "B c h w"], t: Int[Tensor, " B"], condition: Any
    ) -> tuple[Float[Tensor, "B c h w"], Optional[Float[Tensor, "B c h w"]]]:
        """Predict the noise in z, conditional and unconditional (None if ``guidance_scale`` is 1);
        called without gradients.
        """

    @classmethod
    def preflight(cls, cfg: Any) -> None:
        """Check within seconds that a guidance of this configuration can be built; called before
        any long work.

        Raises:
            UserError: a requirement, such as a model's file, is missing; the message says what to
                do.
        """

    REPORTS: tuple[str, ...] = ()
    """The keys of :meth:`report`, which ``checkpoint.monitor`` may name."""

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
        check_options(self.Config, self.cfg, "system.guidance.")
        self.alphas_cumprod = sds.sd_alphas_cumprod()
        self.bad_items = self.bad_steps = 0
        self.update_step(0, 0)

    @property
    def guided(self) -> bool:
        """Whether classifier-free guidance is on, which needs the unconditional score."""
        return self.cfg.guidance_scale != 1

    def update_step(self, epoch: int, global_step: int, on_load_weights: bool = False) -> None:
        """Evaluate the schedules at this step."""
        self.step = global_step
        percents = (
            C(self.cfg[name], epoch, global_step)
            for name in ("min_step_percent", "max_step_percent")
        )
        self.min_step, self.max_step = sds.step_range(*percents, len(self.alphas_cumprod))
        self.grad_clip = (
            None if self.cfg.grad_clip is None else C(self.cfg.grad_clip, epoch, global_step)
        )

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
            guidance_eval: also return ``eval``, the pictures of :meth:`evaluate`.
            batch: the host's batch, and ``comp_rgb_bg``.

        Returns:
            ``loss_sds``; ``grad_norm`` of the batch, and ``grad_norm_0``, ... of each item;
            ``min_step``, ``max_step``; ``bad_items``, the number of items whose score isn't finite;
            the entries of :meth:`report`; and ``eval``, if requested.

        Raises:
            NonFiniteScore: in each of the last ``max_bad_steps`` steps the score of at least one
                item wasn't finite.
        """
        with torch.autocast(rgb.device.type, enabled=False):
            images = rgb.float().movedim(-1, 1).contiguous()
            latents = (images if rgb_as_latents else self.encode(images, **batch)).float()
            with torch.no_grad():
                condition = self.condition(prompt_utils, **batch)
                grad, bad = self._gradient(*self._error(latents, condition))
            if not guidance_eval:  # an evaluation isn't a training step
                self._count_bad(bad)
            loss = _masked_loss(images, latents, grad, bad)
            norms = grad.flatten(1).norm(dim=1)
            out = {
                "loss_sds": loss,
                "grad_norm": norms.norm(),
                "min_step": self.min_step,
                "max_step": self.max_step,
            }
            out |= {f"grad_norm_{i}": norm for i, norm in enumerate(norms)}
            out |= {"bad_items": float(bad.sum()), **self.report()}
            if guidance_eval:
                out["eval"] = self.evaluate(self.add_noise(latents), prompt_utils, **batch)
        return out

    def draw_timesteps(
        self, latents: Float[Tensor, "B c h w"]
    ) -> tuple[Int[Tensor, " B"], Float[Tensor, " B"]]:
        """Draw this step's timesteps t; also return their abar, float64."""
        t = sds.timesteps(
            len(latents),
            self.min_step,
            self.max_step,
            seed=run_seed(),
            step=self.step,
            num_train=len(self.alphas_cumprod),
            first=first_item(len(latents)),
        )
        abar = self.alphas_cumprod.double().cpu()[t]
        return t.to(latents.device), abar.to(latents.device)

    @torch.no_grad()
    def add_noise(self, latents: Float[Tensor, "B c h w"]) -> Noised:
        """Draw this step's timesteps and noise, and add the noise to ``latents``."""
        t, abar = self.draw_timesteps(latents)
        noise = self.normal(latents, "noise")
        return Noised(t, abar, noise, sds.add_noise(latents, noise, abar))

    def normal(self, like: Float[Tensor, "B *d"], stream: str) -> Float[Tensor, "B *d"]:
        """Draw this step's standard normal numbers, of the shape and on the device of ``like``."""
        place = (run_seed(), stream, self.step, like.device, first_item(len(like)))
        return streams.normal_per_item(tuple(like.shape), *place)

    def predict_noise(
        self, z: Float[Tensor, "B c h w"], t: Int[Tensor, " B"], condition: Any
    ) -> Float[Tensor, "B c h w"]:
        """Predict the noise with guidance, float32."""
        cond, uncond = self.predict(z, t, condition)
        return (
            cond.float()
            if uncond is None
            else sds.classifier_free(cond.float(), uncond.float(), self.cfg.guidance_scale)
        )

    def known_error(
        self, latents: Float[Tensor, "B c h w"], condition: Any
    ) -> Optional[tuple[Float[Tensor, "B c h w"], Float[Tensor, " B"]]]:
        """Return eps_hat - eps and abar if they don't depend on the noise, which isn't drawn then;
        None if they do.
        """
        return None

    def _error(
        self, latents: Float[Tensor, "B c h w"], condition: Any
    ) -> tuple[Float[Tensor, "B c h w"], Float[Tensor, " B"]]:
        """Return eps_hat - eps and abar."""
        known = self.known_error(latents, condition)
        if known is not None:
            return known
        noised = self.add_noise(latents)
        return self.predict_noise(noised.z, noised.t, condition) - noised.noise, noised.abar

    def _gradient(
        self, error: Float[Tensor, "B c h w"], abar: Float[Tensor, " B"]
    ) -> tuple[Tensor, Tensor]:
        """Compute w(t) (eps_hat - eps), clipped to ``grad_clip``.

        Returns:
            the gradient, zero for items in which it isn't finite, and a mask of those, (B,) bool.
        """
        grad = sds.per_item(sds.weight(self.cfg.weighting_strategy, abar), error) * error
        bad = _bad_items(grad)
        if bad.any():
            grad[bad] = 0
        return grad if self.grad_clip is None else grad.clamp(-self.grad_clip, self.grad_clip), bad

    def _count_bad(self, bad: Tensor) -> None:
        count = int(bad.sum())
        self.bad_items += count
        self.bad_steps = self.bad_steps + 1 if count else 0
        if self.bad_steps >= self.cfg.max_bad_steps:
            raise NonFiniteScore(
                f"the score model returned NaN or infinity in {self.bad_steps} steps in a row"
                f" (step {self.step}, {self.bad_items} items so far):"
                " use full precision (half_precision_weights=false), and check the model and "
                "the prior"
            )
        if count:
            warn(
                f"step {self.step}: the score of {count} of {len(bad)} items isn't finite; "
                "they are left out"
            )

    # Pictures of the score model's inputs and predictions
    # ---------------------------------------------------------------------------------

    @torch.no_grad()
    def evaluate(self, noised: Noised, prompt_utils: Any, **batch: Any) -> dict[str, Any]:
        """Decode pictures for the host's ``guidance_evaluation_save``.

        Returns:
            pictures (B, H, W, 3) in [0, 1]: ``imgs_noisy``, the noisy latents; ``imgs_1step``,
            denoised in one step with guidance; ``imgs_1orig``, denoised in one step with the
            conditional score only; ``imgs_final``, denoised in ``eval_steps`` steps; and ``texts``,
            ``noise_levels`` and ``bs``, the number of items."""
        count = (
            len(noised.t)
            if self.cfg.max_items_eval < 1
            else min(self.cfg.max_items_eval, len(noised.t))
        )
        batch = _first_items(batch, len(noised.t), count)
        t, abar, _, z = (values[:count] for values in noised)
        condition = self.condition(prompt_utils, **batch)
        alphas_cumprod = self.alphas_cumprod.double().to(z.device)
        latents = {
            "imgs_noisy": z,
            "imgs_1step": sds.predict_x0(z, self.predict_noise(z, t, condition), abar),
            "imgs_1orig": sds.predict_x0(z, self.predict(z, t, condition)[0].float(), abar),
            "imgs_final": sds.ddim_sample(
                lambda z, t: self.predict_noise(z, t, condition),
                z,
                t,
                alphas_cumprod,
                steps=self.cfg.eval_steps,
            ),
        }
        levels = (t / len(alphas_cumprod)).tolist()
        images = {
            name: self.decode(value).float().movedim(1, -1) for name, value in latents.items()
        }
        return {"bs": count, "noise_levels": levels, "texts": _captions(levels, batch), **images}


def _bad_items(grad: Tensor) -> Tensor:
    """Return which items contain NaN or infinity, (B,) bool. If the sum over all elements is finite
    then so are the elements, so the usual case needs a single reduction.
    """
    if grad.sum().isfinite():
        return torch.zeros(len(grad), dtype=torch.bool, device=grad.device)
    return ~torch.isfinite(grad).flatten(1).all(dim=1)


def _masked_loss(images: Tensor, latents: Tensor, grad: Tensor, bad: Tensor) -> Tensor:
    """Compute the loss without the bad items. Their ``grad`` is zero, and the gradients of their
    renders are set to exactly zero.
    """
    if bad.any() and images.requires_grad:
        # If the encoder's derivative is infinite, the product with a zero gradient is NaN.
        images.register_hook(lambda gradient: gradient.masked_fill(bad.reshape(-1, 1, 1, 1), 0.0))
    return sds.sds_loss(latents, grad)


def _first_items(batch: dict[str, Any], size: int, count: int) -> dict[str, Any]:
    """Return the batch of the first ``count`` of ``size`` items."""
    return {
        k: v[:count] if isinstance(v, Tensor) and v.dim() and len(v) == size else v
        for k, v in batch.items()
    }


def _captions(levels: list[float], batch: dict[str, Any]) -> list[str]:
    """Write threestudio's captions: noise level, elevation, azimuth and distance of each item."""
    captions = [f"n{level:.02f}" for level in levels]
    for letter, name, digits in (
        ("e", "elevation", 1),
        ("a", "azimuth", 1),
        ("c", "camera_distances", 2),
    ):
        if name in batch:
            captions = [
                f"{caption}\n{letter}{float(value):.0{digits}f}"
                for caption, value in zip(captions, batch[name], strict=True)
            ]
    return captions


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
