"""Score distillation: what all guidances share, from a render to the gradient of its latent.

    x = encode(render),  z = sqrt(abar) x + sqrt(1 - abar) eps,  grad = w(t) (eps_hat(z, t) - eps),
                         dloss/dx = grad / B

A variant (``variants/``) replaces eps_hat - eps by another residual. A guidance is a subclass that
says how to ``encode`` and ``decode``, what to ``condition`` on, and how to ``predict`` the noise,
with and without its condition; classifier-free guidance, its interval and rescaling are computed
from that pair here, in float32. Timesteps and noise are functions of (seed, step, item).

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
max_step_percent    largest timestep, likewise (the paper: [500, 0.98, 0.55, 501]). With the same
                    number for both all timesteps are that one; with the same schedule,
                    [0, 0.98, 0.02, <steps>], they fall in the course of a run
grad_clip           clamp each element of the latent's gradient to +- this; none, a number or a
                    schedule
weighting_strategy  w(t): sds (1 - abar), uniform (1), fantasia3d (sqrt(abar) (1 - abar)),
                    x0 (sqrt((1 - abar) / abar): the gradient is x minus the denoised x),
                    rectified_flow (1 + sqrt((1 - abar) / abar): the error of a flow's velocity)
==================  ================================================================================
"""

import functools
from abc import ABC, abstractmethod
from collections import Counter
from dataclasses import dataclass, field
from typing import Any, Optional, Tuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ..core import streams
from ..core.devices import DelayedReads, to_device, without_autocast
from ..core.distributed import first_item
from ..core.errors import UserError, unknown
from ..core.options import in_range, interval, one_of, schedule
from ..diffusion import sds
from ..host import BaseObject, C, find, names, parse_structured, run_seed, warn
from ..host.methods import require_method
from .types import Batch, Latents, Noised, Residual, State, Timesteps, items_of, require_pair
from .variants import Variant
from .variants.base import GUIDANCE_SCALE, require_unset
from .variants.vsd import GaussianParticles

__all__ = ["GUIDANCE_SCALE", "NonFiniteScore", "ScoreDistillation"]

EVAL_ITEMS, EVAL_STEPS = 4, 20
"""Items that ``guidance_eval`` shows at most, and DDIM steps to ``imgs_final``."""
ADVICE = (
    "use full precision (half_precision_weights=false), and check the model, the variant and the "
    "prior"
)
MAX_BAD_STEPS = 10
"""A run ends after so many steps in a row in which the score of some item was NaN or infinite."""


class NonFiniteScore(UserError):
    """The score model returned NaN or infinity in ``MAX_BAD_STEPS`` consecutive steps."""


class ScoreDistillation(BaseObject, ABC):
    """Base class of all guidances; see the module's docstring."""

    @dataclass
    class Config(BaseObject.Config):
        guidance_scale: float = field(default=100.0, metadata=GUIDANCE_SCALE)
        min_step_percent: Any = field(default=0.02, metadata=schedule(min=0, max=1))
        max_step_percent: Any = field(default=0.98, metadata=schedule(min=0, max=1))
        guidance_interval: Tuple[float, float] = field(
            default=(0.0, 1.0), metadata=interval(0, 1, "shares of all timesteps")
        )
        recon_std_rescale: float = field(default=0.0, metadata=in_range(0, 1))
        variant_type: str = "sds-variant"
        variant: dict = field(default_factory=dict)
        grad_clip: Any = field(default=None, metadata=schedule(min=0))
        weighting_strategy: str = field(default="sds", metadata=one_of(sds.WEIGHTS))

        REMOVED = {
            "max_items_eval": (lambda count: True, f"guidance_eval shows {EVAL_ITEMS} items"),
            "eval_steps": (lambda steps: True, f"imgs_final takes {EVAL_STEPS} steps"),
            "reuse_steps": (1, "each step evaluates the score model"),
            "timestep_schedule": (
                "uniform",
                "timesteps are random between min_step_percent and max_step_percent; for falling "
                "ones give both the same schedule, such as [0, 0.98, 0.02, <steps>]",
            ),
            "timestep_steps": (lambda steps: True, "it belonged to timestep_schedule"),
            "max_bad_steps": (MAX_BAD_STEPS, f"a run ends after {MAX_BAD_STEPS} of them"),
        }

        @staticmethod
        def check(cfg: Any) -> None:
            percents = cfg.min_step_percent, cfg.max_step_percent
            lists = [entries for entries in percents if not isinstance(entries, (int, float))]
            # all steps at which the slope of a schedule changes, and harmless others
            for step in {0, *(int(entry) for entries in lists for entry in entries)}:
                sds.step_range(*(C(percent, step, step) for percent in percents))
            variant_class(cfg)

    cfg: Config
    SECTION = "system.guidance."
    alphas_cumprod: Float[Tensor, " T"]
    """The noise schedule, float64; a subclass may set another in ``configure``."""
    evaluations: int
    """Of the score model, one per item and prompt, since a step began; ``predict`` counts them."""
    REPORTS: tuple[str, ...] = ()
    """The keys of :meth:`report`, which ``checkpoint.monitor`` may name."""
    UNGUIDED_IGNORES: tuple[str, ...] = ("guidance_interval", "recon_std_rescale")
    """Options that have no effect if ``guidance_scale`` is 1."""
    LOSSES: tuple[str, ...] = ("sds",)
    """Names of the losses that a step returns, without the prefix ``loss_``."""
    NO_LORA = ""
    """Why ``vsd-variant`` can't be used."""
    KNOWS_TRUTH = False
    """Whether instances have an attribute ``truth``, see :func:`.truth_of`."""

    @abstractmethod
    def encode(self, rgb: Float[Tensor, "B 3 H W"], **batch: Any) -> Latents:
        """Encode images in [0, 1], differentiably."""

    @abstractmethod
    def decode(self, latents: Latents) -> Float[Tensor, "B 3 H W"]:
        """Decode latents to images in [0, 1], for display."""

    @abstractmethod
    def condition(self, prompt_utils: Any, **batch: Any) -> Any:
        """Return the conditions on prompt and views for ``predict``; called without gradients."""

    @abstractmethod
    def predict(
        self, z: Latents, t: Timesteps, condition: Any
    ) -> tuple[Latents, Optional[Latents]]:
        """Predict the noise in z, conditional and unconditional; called without gradients. The
        second may be None unless ``needs_unconditional``.
        """

    def select(self, condition: Any, rows: Int[Tensor, " R"]) -> Any:
        """Return the conditions of some items; subclasses whose conditions aren't None, a tensor or
        a list with one entry per item override this.
        """
        if isinstance(condition, list):
            return [condition[row] for row in rows.tolist()]
        if condition is not None and not isinstance(condition, Tensor):
            name, kind = type(self).__name__, type(condition).__name__
            raise UserError(f"{name} has conditions of type {kind}: define its method select")
        return None if condition is None else condition[rows]

    def particle_model(self, options: Any) -> Any:
        """Return the model of the renders that ``vsd-variant``, whose options are given, trains."""
        return GaussianParticles()

    @classmethod
    def preflight(cls, cfg: Any) -> None:
        """Raise UserError if what these options need, such as a model's file, is missing; takes
        seconds, and is called before any long work.
        """
        cfg = parse_structured(cls.Config, cfg)
        variant_class(cfg).preflight(cls, cfg)
        if cfg.guidance_scale == 1:
            require_unset(cls, cfg, cls.UNGUIDED_IGNORES, "with guidance_scale=1, no guidance")

    @classmethod
    def is_text_guided(cls, cfg: Any) -> bool:
        """Return whether the conditional score differs from the unconditional one."""
        return True

    def known_residual(self, latents: Latents, condition: Any) -> Optional[Residual]:
        """Return eps_hat - eps and abar if they don't depend on the noise; None if they do."""
        return None

    def report(self) -> dict[str, float]:
        """Return further numbers about the last step, to be logged."""
        return {}

    # A step ---------------------------------------------------------------------------------------

    def configure(self) -> None:
        self.alphas_cumprod = sds.sd_alphas_cumprod()
        self.evaluations = 0
        self.variant = variant_class(self.cfg)(self.cfg.variant)
        self.bad_items, self.bad_steps = 0, Counter[str]()
        self.reads = DelayedReads()
        self.update_step(0, 0)

    @property
    def renders(self) -> tuple[str, ...]:
        """Names of the renderer's outputs that the batch must have beside ``comp_rgb_bg``."""
        return self.variant.RENDERS

    @property
    def needs_unconditional(self) -> bool:
        """Whether ``predict`` returns the unconditional prediction too."""
        return needs_unconditional(self.cfg, self.variant)

    def update_step(self, epoch: int, global_step: int, on_load_weights: bool = False) -> None:
        """Evaluate the schedules at this step."""
        self.step, options = global_step, self.cfg
        now = (epoch, global_step)
        percents = (C(p, *now) for p in (options.min_step_percent, options.max_step_percent))
        self.min_step, self.max_step = sds.step_range(*percents, len(self.alphas_cumprod))
        self.grad_clip = None if options.grad_clip is None else C(options.grad_clip, *now)

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
            guidance_eval: also return ``eval``, see :func:`score_pictures`.
            batch: the host's batch, and ``comp_rgb_bg``.

        Returns:
            ``loss_sds``; ``grad_norm`` of the batch, and ``grad_norm_0``, ... of each item;
            ``min_step``, ``max_step``; ``bad_items``, the number of items whose score isn't finite;
            ``evaluations`` of the score model, one per item and prompt; what the ``report`` methods
            return; and ``eval``, if requested.

        Raises:
            NonFiniteScore: in each of the last ``MAX_BAD_STEPS`` steps the score of an item wasn't
                finite. On a GPU it is raised when that is known, maybe in a later step.
        """
        self.evaluations = 0
        with without_autocast(rgb.device.type):
            images = rgb.float().movedim(-1, 1).contiguous()
            latents = (images if rgb_as_latents else self.encode(images, **batch)).float()
            with torch.no_grad():
                condition = self.condition(prompt_utils, **batch)
                found = self.variant.residual(self, latents, condition, batch)
                grad, bad = self._gradient(found, latents)
            if not guidance_eval:  # an evaluation isn't a training step
                self.count_bad(bad, "the score", ADVICE)
                self.variant.learn(self, latents.detach(), condition, batch, ~bad)
            if images.requires_grad and may_have_any(bad):
                # if the encoder's derivative is infinite, its product with a zero gradient is NaN
                images.register_hook(lambda gradient: without_bad_items(gradient, bad))
            norms = torch.linalg.vector_norm(grad.flatten(1), dim=1)
            out = self._result(sds.sds_loss(latents, grad), norms, bad.sum().float())
            if guidance_eval:
                out["eval"] = score_pictures(self, self.add_noise(latents), prompt_utils, batch)
        return out

    def _result(
        self, loss: Float[Tensor, ""], norms: Float[Tensor, " B"], bad_items: Float[Tensor, ""]
    ) -> dict[str, Any]:
        """Return the loss and what is logged; ``norms`` are those of each item's gradient."""
        out = {
            "loss_sds": loss,
            "grad_norm": torch.linalg.vector_norm(norms),
            "min_step": self.min_step,
            "max_step": self.max_step,
            **{f"grad_norm_{i}": norm for i, norm in enumerate(norms.unbind(0))},
            "bad_items": bad_items,
            "evaluations": float(self.evaluations),
        }
        return out | (self.report() or {}) | (self.variant.report() or {})

    def _gradient(self, found: Any, latents: Latents) -> tuple[Latents, Bool[Tensor, " B"]]:
        """Weight and clip the residual; also return which items aren't finite, set to zero."""
        shapes, name = (tuple(latents.shape), (len(latents),)), type(self.variant).__name__
        said = f"the residual and abar, tensors of the shapes {shapes}"
        residual, abar = require_pair(f"{name}.residual", found, [shapes], said)
        weight = sds.WEIGHTS[self.cfg.weighting_strategy](abar)
        grad = sds.per_item(weight, residual) * residual
        bad = find_bad_items(grad)
        if may_have_any(bad):
            grad = without_bad_items(grad, bad)
        return grad if self.grad_clip is None else grad.clamp(-self.grad_clip, self.grad_clip), bad

    def count_bad(self, bad: Bool[Tensor, " B"], what: str, advice: str) -> None:
        """Warn of items that aren't finite, when their number is known, or raise NonFiniteScore
        with the advice after ``MAX_BAD_STEPS`` steps in a row.
        """
        self.reads.submit(bad, functools.partial(self._note_bad, self.step, what, advice))

    def _note_bad(self, step: int, what: str, advice: str, bad: Bool[Tensor, " B"]) -> None:
        self.bad_items += (count := int(bad.sum()))
        self.bad_steps[what] = self.bad_steps[what] + 1 if count else 0
        if self.bad_steps[what] >= MAX_BAD_STEPS:
            said = f"{what} had NaN or infinity in {self.bad_steps[what]} steps in a row"
            raise NonFiniteScore(f"{said} (step {step}, {self.bad_items} items so far): {advice}")
        if count:
            warn(f"step {step}: {what} of {count} of {len(bad)} items isn't finite: left out")

    def state(self) -> State:
        """Return the tensors that a checkpoint needs to resume; empty for most configurations."""
        return self.variant.state()

    def restore(self, state: State) -> None:
        """Restore what :meth:`state` returned; raise UserError for another configuration's."""
        # earlier versions kept predictions for several steps
        kept = {name: value for name, value in state.items() if not name.startswith("kept.")}
        self.variant.restore(self, kept)

    # Predictions ----------------------------------------------------------------------------------

    def predict_noise(self, z: Latents, t: Timesteps, condition: Any) -> Latents:
        """Predict the noise with guidance: that of ``guidance_scale`` for items inside of
        ``guidance_interval``, none for others.
        """
        cfg, count = self.cfg, len(self.alphas_cumprod)
        low, high = (share * count for share in cfg.guidance_interval)
        options = {"scale": cfg.guidance_scale, "rescale": cfg.recon_std_rescale}
        guided = functools.partial(self.guided_noise, **options)
        inside = None if (low, high) == (0, count) else (t >= low) & (t <= high)
        if inside is None or inside.all():
            return guided(z, t, condition)
        eps = torch.empty_like(z)
        for predict, chosen in ((guided, inside), (self.conditional, ~inside)):
            rows = chosen.nonzero()[:, 0]
            if len(rows):
                eps[rows] = predict(z[rows], t[rows], self.select(condition, rows))
        return eps

    def guided_noise(
        self, z: Latents, t: Timesteps, condition: Any, scale: float, *, rescale: float = 0.0
    ) -> Latents:
        """Predict the noise with classifier-free guidance.

        Args:
            scale: 1 for no guidance.
            rescale: see ``recon_std_rescale``.
        """
        if (eps := self.guided_at_once(z, t, condition, scale, rescale)) is not None:
            return eps
        cond, uncond = self._pair(self.predict(z, t, condition), z)
        if uncond is None and scale != 1:
            _warn_of_no_effect(scale, type(self).__name__)
        eps = cond if uncond is None else sds.classifier_free(cond, uncond, scale)
        if rescale and scale != 1:
            eps = sds.rescaled(eps, cond, z, self.abar_of(t), rescale)
        return eps

    def guided_at_once(
        self, z: Latents, t: Timesteps, condition: Any, scale: float, rescale: float
    ) -> Optional[Latents]:
        """Return what :meth:`guided_noise` does, where one evaluation per view gives it."""
        return None

    def both(self, z: Latents, t: Timesteps, condition: Any) -> tuple[Latents, Latents]:
        """Predict the noise, conditional and unconditional; twice the same if there is only one."""
        cond, uncond = self._pair(self.predict(z, t, condition), z)
        return cond, cond if uncond is None else uncond

    def conditional(self, z: Latents, t: Timesteps, condition: Any) -> Latents:
        """Predict the conditional noise alone; subclasses that can save time here override it."""
        return self.both(z, t, condition)[0]

    def unconditional(self, z: Latents, t: Timesteps, condition: Any) -> Latents:
        """Predict the unconditional noise alone; subclasses that can save time here override it."""
        return self.both(z, t, condition)[1]

    def empty_prompt(self, z: Latents, t: Timesteps, condition: Any) -> Optional[Latents]:
        """Predict the noise for an empty prompt if the negative one isn't empty; else None."""
        return None

    def _pair(self, found: Any, z: Latents) -> tuple[Latents, Optional[Latents]]:
        """Return what ``predict`` returned, in the type of z, after a look at its shapes."""
        shape = tuple(z.shape)
        said = (
            f"a pair, conditional and unconditional (or None), of the shape {shape} of the latents"
        )
        accepted = [(shape, shape), (shape, "NoneType")]
        cond, uncond = require_pair(f"{type(self).__name__}.predict", found, accepted, said)
        return cond.to(z), None if uncond is None else uncond.to(z)

    # The noise of a step --------------------------------------------------------------------------

    def abar_of(self, t: Int[Tensor, "*b"]) -> Float[Tensor, "*b"]:
        """Return abar of timesteps, on their device."""
        return self.alphas_cumprod.to(t.device)[t]

    def draw_timesteps(self, latents: Latents) -> tuple[Timesteps, Float[Tensor, " B"]]:
        """Draw this step's timesteps t; also return their abar, float64."""
        return self.timesteps_between(latents, self.min_step, self.max_step, "timestep")

    def timesteps_between(
        self, latents: Latents, low: int, high: int, stream: str
    ) -> tuple[Timesteps, Float[Tensor, " B"]]:
        """Draw timesteps, uniform on [low, high], from a random stream of this step; and abar."""
        options = {"seed": run_seed(), "step": self.step, "num_train": len(self.alphas_cumprod)}
        options |= {"stream": stream, "first": first_item(len(latents))}
        t = sds.timesteps(len(latents), low, high, **options)
        abar = self.alphas_cumprod.double().cpu()[t]
        return to_device(t, latents.device), to_device(abar, latents.device)

    @torch.no_grad()
    def add_noise(self, latents: Latents, noise: Optional[Latents] = None) -> Noised:
        """Add noise to ``latents`` at this step's timesteps: this step's, unless it is given."""
        noise = self.normal(latents, "noise") if noise is None else noise
        t, abar = self.draw_timesteps(latents)
        return Noised(t, abar, noise, sds.diffuse(latents, noise, abar))

    def normal(self, like: Float[Tensor, "B *d"], stream: str) -> Float[Tensor, "B *d"]:
        """Draw this step's standard normal numbers, of the shape and on the device of ``like``."""
        place = run_seed(), stream, self.step, like.device, first_item(len(like))
        return streams.normal_per_item(tuple(like.shape), *place)


def needs_unconditional(cfg: Any, variant: Variant | type[Variant]) -> bool:
    """Return whether these options, with this variant, need the unconditional prediction too."""
    return cfg.guidance_scale != 1 or variant.NEEDS_UNCONDITIONAL


def variant_class(cfg: Any) -> type[Variant]:
    """Return the class that ``variant_type`` names; raise UserError if it is none."""
    known = {
        name
        for name in names()
        if isinstance(part := find(name), type) and issubclass(part, Variant)
    }
    if cfg.variant_type not in known:
        raise UserError(f"variant_type: {unknown('variant', cfg.variant_type, sorted(known))}")
    found = find(cfg.variant_type)
    require_method(found, "residual", "guidance", "latents", "condition", "batch")
    return found


@functools.lru_cache
def _warn_of_no_effect(scale: float, name: str) -> None:
    """Warn, once per process, of a scale where there is only one prediction."""
    warn(f"guidance_scale={scale:g} has no effect: {name}.predict returns no unconditional one")


@torch.no_grad()
def score_pictures(
    guidance: Any, noised: Noised, prompt_utils: Any, batch: Batch
) -> dict[str, Any]:
    """Return pictures (B, H, W, 3) in [0, 1], under threestudio's names: ``imgs_noisy``, the noisy
    latents; denoised in one step with guidance ``imgs_1step``, with the conditional score alone
    ``imgs_1orig``; in ``EVAL_STEPS`` steps ``imgs_final``; and captions: noise level, elevation,
    azimuth and distance of each item.
    """
    size, views = len(noised.t), getattr(guidance.cfg, "n_view", 1)
    count = min(size, max(EVAL_ITEMS // views, 1) * views)
    batch = items_of(batch, size, slice(count))
    t, abar, _, z = (values[:count] for values in noised)
    condition = guidance.condition(prompt_utils, **batch)
    table = guidance.alphas_cumprod.double().to(z.device)
    latents = {
        "imgs_noisy": z,
        "imgs_1step": sds.predict_x0(z, guidance.predict_noise(z, t, condition), abar),
        "imgs_1orig": sds.predict_x0(z, guidance.predict(z, t, condition)[0].float(), abar),
        "imgs_final": sds.ddim_sample(
            lambda z, t: guidance.predict_noise(z, t, condition), z, t, table, steps=EVAL_STEPS
        ),
    }
    images = {name: guidance.decode(x).float().movedim(1, -1) for name, x in latents.items()}
    levels = (t / len(guidance.alphas_cumprod)).tolist()
    shown = {"noise": "n.2f", "elevation": "e.1f", "azimuth": "a.1f", "camera_distances": "c.2f"}
    values = {"noise": levels, **batch}
    columns = [
        [f"{form[0]}{float(value):{form[1:]}}" for value in values[name]]
        for name, form in shown.items()
        if name in values
    ]
    texts = ["\n".join(lines) for lines in zip(*columns, strict=True)]
    return {"bs": count, "noise_levels": levels, "texts": texts, **images}


def find_bad_items(grad: Float[Tensor, "B *d"]) -> Bool[Tensor, " B"]:
    """Return which items contain NaN or infinity."""
    # if the sum over all elements is finite then so are the elements
    if not grad.is_cuda and grad.sum().isfinite():
        return torch.zeros(len(grad), dtype=torch.bool, device=grad.device)
    return ~torch.isfinite(grad).flatten(1).all(dim=1)


def may_have_any(bad: Bool[Tensor, " B"]) -> bool:
    """Return whether any item is bad; true on a GPU, where looking would wait for the score."""
    return bad.is_cuda or bool(bad.any())


def without_bad_items(values: Float[Tensor, "B *d"], bad: Bool[Tensor, " B"]) -> Tensor:
    """Return the values with those of bad items set to zero."""
    return values.masked_fill(bad.reshape(-1, *[1] * (values.dim() - 1)), 0.0)
