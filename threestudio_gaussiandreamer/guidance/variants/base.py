"""The base class of variants of score distillation.

A variant turns the predictions of a score model into the residual e of the latents x =
encode(render); the gradient is w(t) e (``guidance/base.py``). The notation is that of
``diffusion/sds.py``; eps_c and eps_u are the conditional and the unconditional prediction, and
eps_hat = eps_u + guidance_scale (eps_c - eps_u)."""

from abc import ABC, abstractmethod
from collections.abc import Collection
from dataclasses import dataclass
from typing import Any, ClassVar

from ...core.errors import UserError
from ...core.options import in_range, require_defaults
from ...host import BaseObject, warn
from ..types import Batch, Good, Latents, Residual, State, require_resumable

GUIDANCE_SCALE = in_range(-1e6, 1e6)


def require_unset(guidance: type, cfg: Any, names: Collection[str], reason: str) -> None:
    """Raise UserError if options without effect are set; a rescaling by 0 does nothing anyway."""
    names = [n for n in names if n != "recon_std_rescale" or getattr(cfg, n, 0) != 0]
    require_defaults(guidance.Config, cfg, names, reason, guidance.SECTION)


class Variant(BaseObject, ABC):
    """A rule that maps latents and a score model to the residual of the latents."""

    @dataclass
    class Config(BaseObject.Config):
        pass

    cfg: Config
    SECTION = "system.guidance.variant."

    NEEDS_UNCONDITIONAL: ClassVar[bool] = False
    """Whether the unconditional score is needed even if ``guidance_scale`` is 1."""
    NEEDS_TEXT: ClassVar[bool] = False
    """Whether the residual vanishes where the conditional score is the unconditional one."""
    NEEDS_EMPTY_PROMPT: ClassVar[bool] = False
    """Whether :meth:`.ScoreDistillation.empty_prompt` is called."""
    IGNORES: ClassVar[tuple[str, ...]] = ()
    """Options of the guidance that have no effect on the residual."""
    RENDERS: ClassVar[tuple[str, ...]] = ()
    """Outputs of the renderer that :meth:`residual` reads from the batch, such as ``depth``."""

    def __init_subclass__(cls, **options: Any) -> None:
        super().__init_subclass__(**options)
        if "error" in vars(cls) and "residual" not in vars(cls):
            warn(f"{cls.__name__}.error is called residual now: rename the method")
            cls.residual = cls.error

    @classmethod
    def preflight(cls, guidance: type, cfg: Any) -> None:
        """Raise UserError if the variant doesn't work with this class and these options."""
        if cls.NEEDS_TEXT and not guidance.is_text_guided(cfg):
            raise UserError(
                f"system.guidance.variant_type: {cfg.variant_type} follows the difference of "
                "conditional and unconditional score, which is zero with the guidance's options"
            )
        require_unset(guidance, cfg, cls.IGNORES, f"with {cfg.variant_type}")

    @abstractmethod
    def residual(self, guidance: Any, latents: Latents, condition: Any, batch: Batch) -> Residual:
        """Compute the residual of the latents; called without gradients.

        Args:
            guidance: a :class:`.ScoreDistillation`.
            condition: what ``guidance.condition`` returned.
            batch: the host's batch, and the outputs of the renderer in ``RENDERS``.
        """

    def learn(
        self, guidance: Any, latents: Latents, condition: Any, batch: Batch, good: Good
    ) -> None:
        """Train the variant after a step's residual; ``good`` are the items with a finite one."""

    def report(self) -> dict[str, float]:
        """Return further numbers about the last step, to be logged."""
        return {}

    def state(self) -> State:
        """Return the tensors that a checkpoint needs to resume; empty for most variants."""
        return {}

    def restore(self, guidance: Any, state: State) -> None:
        """Restore what :meth:`state` returned; raise UserError for that of another variant."""
        require_resumable(state, set())
