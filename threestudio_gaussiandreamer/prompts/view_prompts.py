"""Text embeddings per view, the output of prompt processors with a text encoder, as threestudio's.

The direction of a view (side, or left and right side; front, back, overhead) selects the prompt,
such as "a fox, front view". With Perp-Neg (Armandpour et al. 2023) a view between two directions
gets their interpolated embedding, and the other directions as negative prompts whose weights decay
with the angle. Angles are in degrees; azimuth 0 is the front."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Dict, List, NamedTuple, Optional, Tuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

Condition = Callable[[Tensor, Tensor, Tensor], Tensor]
PERP_NEG = {
    "sb": (1.0, 0.5, -0.606),
    "fsb": (1.0, 0.5, 0.967),
    "fs": (4.0, 0.5, -2.426),
    "sf": (4.0, 0.5, -2.426),
}
"""threestudio's coefficients (a, b, c) of the weights -(a exp(-b r) + c) of the negative prompts:

- for a view between front and side: ``fs`` for "front", with r the share of "front" in the
  interpolated prompt, and ``sf`` for "side", with r the share of "side";
- for a view between side and back: ``sb`` for "side" and ``fsb`` for "front", both with r the
  share of "side".
"""
THRESHOLDS = {"front_threshold": 45.0, "back_threshold": 45.0, "overhead_threshold": 60.0}
"""threestudio's half widths of front and back, and the elevation above which views are overhead."""


class Direction(NamedTuple):
    """A view direction; a view takes the last one in :func:`view_directions` that it satisfies."""

    name: str
    condition: Condition
    """Maps (elevation, azimuth, camera_distances), each (B,), to bool (B,): which views have this
    direction.
    """


def view_directions(*, left_and_right: bool = False) -> List[Direction]:
    """Return threestudio's directions in its order: side, front, back, overhead.

    Args:
        left_and_right: "left side", the object's own (azimuths in [0, 180)), and "right side" in
            place of "side".
    """
    front, back, overhead = THRESHOLDS.values()
    sides: Dict[str, Condition] = {
        "left side": lambda elevation, azimuth, distance: shifted(azimuth) >= 0,
        "right side": lambda elevation, azimuth, distance: shifted(azimuth) < 0,
    }
    if not left_and_right:
        sides = {"side": lambda elevation, *_: torch.ones_like(elevation, dtype=torch.bool)}
    conditions: Dict[str, Condition] = {
        **sides,
        "front": lambda elevation, azimuth, distance: abs(shifted(azimuth)) < front,
        "back": lambda elevation, azimuth, distance: abs(shifted(azimuth)) > 180 - back,
        "overhead": lambda elevation, azimuth, distance: elevation > overhead,
    }
    return [Direction(*item) for item in conditions.items()]


def direction_indices(
    directions: List[Direction], elevation: Tensor, azimuth: Tensor, camera_distances: Tensor
) -> Int[Tensor, " B"]:
    """Return the index of the direction of each view, given by (B,) in degrees and world units."""
    indices = torch.zeros_like(elevation, dtype=torch.long)
    for index, direction in enumerate(directions):
        indices[direction.condition(elevation, azimuth, camera_distances)] = index
    return indices


def shifted(azimuth: Float[Tensor, " B"]) -> Float[Tensor, " B"]:
    """Return the azimuth, in degrees, shifted to [-180, 180)."""
    return (azimuth + 180) % 360 - 180


@dataclass
class PromptEmbeddings:
    """The embeddings of one prompt; the names are those of threestudio's ``PromptProcessorOutput``.

    Each embedding has N tokens of F features; ``*_vd`` hold one per direction.
    """

    text_embeddings: Float[Tensor, "1 N F"]
    uncond_text_embeddings: Float[Tensor, "1 N F"]
    text_embeddings_vd: Float[Tensor, "D N F"]
    uncond_text_embeddings_vd: Float[Tensor, "D N F"]
    directions: List[Direction]
    direction2idx: Dict[str, int]
    use_perp_neg: bool
    prompt: str
    prompts_vd: List[str]
    empty: Optional[Callable[[], Float[Tensor, "1 N F"]]] = None
    """Returns the embedding of an empty prompt; None if the negative one is. Not threestudio's."""

    def get_text_embeddings(
        self,
        elevation: Float[Tensor, " B"],
        azimuth: Float[Tensor, " B"],
        camera_distances: Float[Tensor, " B"],
        view_dependent_prompting: bool = True,
    ) -> Float[Tensor, "2*B N F"]:
        """Return the embeddings of the views' prompts, then those of their negative prompts.

        Args:
            elevation, azimuth: degrees.
            view_dependent_prompting: use the prompt of each view's direction; else the same prompt
                for all.
        """
        if view_dependent_prompting:
            rows = direction_indices(self.directions, elevation, azimuth, camera_distances)
            rows = rows.to(self.text_embeddings_vd.device)
            return torch.cat([self.text_embeddings_vd[rows], self.uncond_text_embeddings_vd[rows]])
        both = self.text_embeddings, self.uncond_text_embeddings
        return torch.cat([one.expand(len(elevation), -1, -1) for one in both])

    def get_text_embeddings_perp_neg(
        self,
        elevation: Float[Tensor, " B"],
        azimuth: Float[Tensor, " B"],
        camera_distances: Float[Tensor, " B"],
        view_dependent_prompting: bool = True,
    ) -> Tuple[Float[Tensor, "4*B N F"], Float[Tensor, "B 2"]]:
        """Return the embeddings of the views' prompts, of their negative prompts, then two Perp-Neg
        rows per view; and the weights of those two, which are <= 0.

        The two Perp-Neg rows of a view are adjacent (view 0 first, view 0 second, view 1 first,
        ...), as in threestudio. With more than one view threestudio's guidances combine them with
        the latents of other views; this package's guidances pair them by view.
        """
        device = self.text_embeddings_vd.device
        rows = direction_indices(self.directions, elevation, azimuth, camera_distances).to(device)
        overhead = rows == self.direction2idx["overhead"]
        names = ("left side", "right side") if "left side" in self.direction2idx else ("side",) * 2
        left, right = (self.direction2idx[name] for name in names)
        side = torch.where(shifted(azimuth) >= 0, left, right).to(device)
        angle = shifted(azimuth).abs().to(device)
        front, back = (torch.full_like(side, self.direction2idx[k]) for k in ("front", "back"))
        in_front, pair_in_front = (angle < 90)[:, None], torch.stack([front, side], 1)
        # the two directions that a view lies between, and the share of the first one in its prompt
        pair = torch.where(in_front, pair_in_front, torch.stack([side, back], 1))
        share = torch.where(angle < 90, 1 - angle / 90, 2 - angle / 90)
        embeddings, uncond = self.text_embeddings_vd, self.uncond_text_embeddings_vd[rows]
        first = share.to(embeddings)[:, None, None]
        positive = first * embeddings[pair[:, 0]] + (1 - first) * embeddings[pair[:, 1]]
        # overhead views aren't interpolated, and have no other directions as negative prompts
        positive = torch.where(overhead[:, None, None], embeddings[rows], positive)
        negative = torch.where(
            overhead[:, None, None, None],
            uncond[:, None],
            embeddings[torch.where(in_front, pair_in_front, pair_in_front.flip(1))],
        )
        front_half = torch.stack([decay("fs", share), decay("sf", 1 - share)], dim=1)
        back_half = torch.stack([decay("sb", share), decay("fsb", share)], dim=1)
        decays = torch.where(in_front, front_half, back_half)
        weights = torch.where(overhead[:, None], 0.0, -decays)
        return torch.cat([positive, uncond, negative.flatten(0, 1)]), weights.to(elevation.device)


def decay(name: str, r: Tensor) -> Tensor:
    """Compute a exp(-b r) + c with the coefficients of this name in ``PERP_NEG``."""
    a, b, c = PERP_NEG[name]
    return a * torch.exp(-b * r) + c
