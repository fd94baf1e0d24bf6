"""View contrast: the conditional prediction moved away from that for the opposite view's prompt,

    eps_c' = eps_c + view_contrast (eps_c - eps_o),

where o is the prompt of the view from the other side of the object: "front view" for "back view",
and "left side view" for "right side view" where the prompts tell these apart. It is the negation
of a concept as in composable diffusion (Liu et al. 2022, arXiv:2206.01714), for models whose views
of a prompt are alike; what it brings is measured in docs/toybox.md. Perp-Neg (Armandpour et al.
2023) takes away only what is perpendicular to eps_c - eps_u.

==================  ================================================================================
option              meaning
==================  ================================================================================
view_contrast       factor of the difference; 0: none
view_contrast_from  smallest timestep, as a share of all, at which it is applied; large ones decide
                    the view. Each view at or above it costs one more evaluation, also where both
                    sides have the same prompt ("overhead view", "side view")
==================  ================================================================================

It is part of guidance, so outside of ``guidance_interval`` there is none.
"""

from typing import TYPE_CHECKING, Any

from jaxtyping import Float, Int
from torch import Tensor

from ..core.errors import UserError
from .text_condition import Condition

if TYPE_CHECKING:
    from .text_to_image import TextToImageDistillation


NOT_WITH_PERP_NEG = (
    "view_contrast and Perp-Neg both compare the prompts of views: set "
    "system.prompt_processor.use_perp_neg=false, or system.guidance.view_contrast=0"
)


def check_view_contrast(cfg: Any) -> None:
    """Raise UserError unless the options leave a prompt for each view.

    Args:
        cfg: the options of the guidance.
    """
    if cfg.view_contrast and not cfg.view_dependent_prompting:
        raise UserError(
            "view_contrast compares the prompts of opposite views: set "
            "view_dependent_prompting=true, or view_contrast=0"
        )


def opposite(
    prompt_utils: Any,
    elevation: Float[Tensor, " B"],
    azimuth: Float[Tensor, " B"],
    *other: Any,
) -> Float[Tensor, "B N F"]:
    """Return the embeddings of the opposite views' prompts.

    Args:
        prompt_utils: see :meth:`.TextToImageDistillation.condition`.
        elevation, azimuth: of the views, degrees.
        other: further arguments of ``get_text_embeddings``.

    Raises:
        UserError: the prompts use Perp-Neg, which has negative prompts of its own.
    """
    if getattr(prompt_utils, "use_perp_neg", False):
        raise UserError(NOT_WITH_PERP_NEG)
    embeddings = prompt_utils.get_text_embeddings(elevation, azimuth + 180, *other)
    return embeddings[: len(azimuth)]


def contrasted(
    guidance: "TextToImageDistillation",
    eps: Float[Tensor, "B c h w"],
    z: Float[Tensor, "B c h w"],
    t: Int[Tensor, " B"],
    condition: Condition,
    scale: float = 1.0,
) -> Float[Tensor, "B c h w"]:
    """Return the conditional predictions ``eps`` with view contrast, if the condition has it.

    Args:
        scale: of guidance in ``eps``, if the network takes it as an input.
    """
    if condition.opposite is None:
        return eps
    first = guidance.cfg.view_contrast_from * len(guidance.alphas_cumprod)
    rows = (t >= first).nonzero()[:, 0]
    if not len(rows):
        return eps
    other = guidance.noise(z[rows], t[rows], condition.opposite[rows], scale)
    return eps.index_add(0, rows, eps[rows] - other, alpha=guidance.cfg.view_contrast)
