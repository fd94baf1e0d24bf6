"""The base class of variants of score distillation.

A variant turns the predictions of a score model into the error e of the latents x = encode(render);
all else is the same for each: the gradient is w(t) e, clipped, without items that aren't finite
(``guidance/base.py``). The notation is that of ``sds.py``, and of classifier-free guidance:
eps_c and eps_u are the conditional and the unconditional prediction, eps_hat = eps_u +
guidance_scale (eps_c - eps_u)."""

from abc import ABC, abstractmethod
from collections.abc import Collection
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

from jaxtyping import Bool, Float
from torch import Tensor

from ...core.errors import UserError
from ...core.options import checked_options, require_defaults
from ...host import BaseObject

if TYPE_CHECKING:
    from ..base import ScoreDistillation

Error = tuple[Float[Tensor, "B c h w"], Float[Tensor, " B"]]
"""The error e, and abar of each item, float64, of which w(t) is a function."""
Batch = dict[str, Any]
OFF = {"recon_std_rescale": 0.0}
"""Values with which options do nothing, where a guidance's default is another."""


def require_unset(
    guidance: type["ScoreDistillation"], cfg: Any, names: Collection[str], reason: str
) -> None:
    """Raise UserError if options of a guidance that have no effect are neither at their defaults
    nor off; see :func:`.require_defaults`.
    """
    prefix = "system.guidance."
    require_defaults(guidance.Config, cfg, names, reason, prefix=prefix, neutral=OFF)


class Variant(BaseObject, ABC):
    """A rule that maps latents and a score model to the error of the latents."""

    @dataclass
    class Config(BaseObject.Config):
        pass

    cfg: Config
    options: Any
    """Of ``cfg``, as plain attributes."""

    NEEDS_UNCONDITIONAL: ClassVar[bool] = False
    """Whether the unconditional score is needed even if ``guidance_scale`` is 1."""

    NEEDS_TEXT: ClassVar[bool] = False
    """Whether the error vanishes where the conditional score is the unconditional one."""

    NEEDS_EMPTY_PROMPT: ClassVar[bool] = False
    """Whether :meth:`.ScoreModel.empty_prompt` is called."""

    IGNORES: ClassVar[tuple[str, ...]] = ()
    """Options of the guidance that have no effect on the error."""

    RENDERS: ClassVar[tuple[str, ...]] = ()
    """Outputs of the renderer that :meth:`error` reads from the batch, such as ``depth``."""

    def configure(self) -> None:
        self.options = checked_options(self.Config, self.cfg, "system.guidance.variant.")

    @classmethod
    def preflight(cls, guidance: type["ScoreDistillation"], cfg: Any) -> None:
        """Check, before any model is loaded, that the variant works with a guidance.

        Args:
            cfg: the options of the guidance.

        Raises:
            UserError: it doesn't.
        """
        if cls.NEEDS_TEXT and not guidance.is_text_guided(cfg):
            raise UserError(
                f"system.guidance.variant_type: {cfg.variant_type} follows the difference of "
                "conditional and unconditional score, which is zero with these options of the "
                "guidance"
            )
        require_unset(guidance, cfg, cls.IGNORES, f"with {cfg.variant_type}")

    @abstractmethod
    def error(
        self,
        guidance: "ScoreDistillation",
        latents: Float[Tensor, "B c h w"],
        condition: Any,
        batch: Batch,
    ) -> Error:
        """Compute the error of the latents; called without gradients.

        Args:
            condition: what ``guidance.condition`` returned.
            batch: the host's batch, and the outputs of the renderer in ``RENDERS``.
        """

    def learn(
        self,
        guidance: "ScoreDistillation",
        latents: Float[Tensor, "B c h w"],
        condition: Any,
        batch: Batch,
        good: Bool[Tensor, " B"],
    ) -> None:
        """Train what the variant trains, after the error of a training step has been computed.

        Args:
            good: items whose error is finite.
        """

    def report(self) -> dict[str, float]:
        """Return further numbers about the last step, to be logged."""
        return {}

    def state(self) -> dict[str, Tensor]:
        """Return the tensors that a checkpoint needs to resume; empty for most variants."""
        return {}

    def restore(self, guidance: "ScoreDistillation", state: dict[str, Tensor]) -> None:
        """Restore what :meth:`state` returned.

        Raises:
            UserError: the tensors aren't those of this variant.
        """
        if state:
            raise UserError(
                f"the checkpoint has {len(state)} tensors of another variant of score "
                "distillation: resume with the configuration that the run was started with"
            )


def checked_error(variant: Variant, found: Any, latents: Float[Tensor, "B c h w"]) -> Error:
    """Return what a variant's ``error`` returned.

    Raises:
        UserError: it isn't a pair of tensors of these shapes; others might be broadcast silently.
    """
    expected = (tuple(latents.shape), (len(latents),))
    pair = found if isinstance(found, tuple) else (found,)
    shapes = tuple(tuple(x.shape) if isinstance(x, Tensor) else type(x).__name__ for x in pair)
    if shapes != expected:
        raise UserError(
            f"{type(variant).__name__}.error returned {shapes}; expected the error and abar, "
            f"tensors of the shapes {expected}"
        )
    return found
