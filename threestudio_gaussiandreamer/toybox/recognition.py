"""Recognise the toybox's attributes in pictures of a result with the judge.

===========  ===================================================================================
kind         whether the kind with the highest probability, averaged over the views, is the prompt's
colors       whether the body's colour and the pattern's are the prompt's; for stripes and checks,
             which look alike with their colours exchanged, in either order; of a person, whether
             those of shirt and trousers are
pattern      whether the pattern is the prompt's
accessory    whether the coloured part, the accessory and its colour all are the prompt's; of a
             person, the accessory and its colour
action       of a person: whether what it does is the prompt's, with either side
sides        of a person: whether its left or right is the prompt's; NaN for actions that have no
             side, or aren't recognised
multi_face   share of the views that the judge takes for views from another quadrant; NaN for
             objects that look alike from all sides
===========  ===================================================================================
"""

import math

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ..cameras import Orbit
from ..models.bundled import JUDGE, NAME, model_part
from . import motions
from .kinds import ALIKE_FROM_ALL_SIDES
from .models import Judge
from .views import DISTANCE, FOVY_DEG, LABELS, exchanged
from .world import PERSON, Attributes

VERSION = 3
"""Changes with what is read from the same probabilities."""
ELEVATION_DEG = 15.0
OFFSETS_DEG = (-22.5, 22.5)
"""Azimuths of a quadrant's two views, relative to its middle."""


def load_judge(name: str) -> Judge:
    """Load a judge that ``toybox.export`` wrote: ``toybox``, the folder of an export, or the file.
    Raise UserError if there is no such file, or it doesn't hold a judge."""
    from ..models.model_files import load_exactly, read_state_dict

    path, judge = model_part(name, JUDGE), Judge()
    kind = f"judge ({NAME}, or the export of a training that has one: make train-toybox)"
    load_exactly(judge, read_state_dict(path, kind), f"judge {path!r}")
    return judge.eval()


def views() -> Orbit:
    """Return the eight views that the judge sees, two of each quadrant in the order of LABELS."""
    azimuth = torch.tensor([90.0 * side + offset for side in range(4) for offset in OFFSETS_DEG])
    ones, distance, fovy = torch.ones_like(azimuth), sum(DISTANCE) / 2, math.radians(FOVY_DEG)
    around = (azimuth + 180) % 360 - 180
    return Orbit(ELEVATION_DEG * ones, around, distance * ones, fovy * ones)


@torch.no_grad()
def probabilities(
    judge: Judge, pictures: Float[Tensor, "V 3 s s"], wanted: Attributes
) -> dict[str, Tensor]:
    """Return each attribute's probabilities (V, classes) in pictures in [0, 1], in the order of
    :func:`views`, of what a prompt asks for, an object or a person."""
    persons = torch.full((len(pictures),), wanted.kind == PERSON)
    found = {name: logits.softmax(dim=-1) for name, logits in judge(pictures, persons).items()}
    seen, from_behind = found["action"], behind(views().azimuth)[:, None]  # sides of the picture
    found["action"] = torch.where(from_behind, seen[:, exchanged("action")], seen)
    return found


def behind(azimuth: Float[Tensor, " V"]) -> Bool[Tensor, " V"]:
    """Return whether azimuths in degrees are of views from behind."""
    return (azimuth + 90) % 360 > 180


def recognized(found: dict[str, Tensor], wanted: Attributes) -> dict[str, float]:
    """Return 1, 0 or NaN for each attribute: whether the pictures show the prompt's, or none."""
    names = ("kind", "color", "part", "accessory", "accessory_color", "action")
    shown = {name: LABELS[name][int(found[name].mean(dim=0).argmax())] for name in names}
    right = {name: shown[name] == (getattr(wanted, name) or "none") for name in names}
    worn = right["accessory"] and right["accessory_color"]
    pattern, *colors = most_probable_pattern(found)
    asked = [wanted.color, wanted.second or "none"]
    exchanged = wanted.pattern in ("striped", "checkered") and colors == asked[::-1]
    rights = {
        "kind": right["kind"],
        "colors": colors == asked or exchanged,
        "pattern": pattern == wanted.pattern,
        "accessory": right["part"] and worn,
    }
    if wanted.action:
        (does, side), (action, wanted_side) = map(motions.split, (shown["action"], wanted.action))
        rights |= {
            "colors": right["color"] and right["part"],
            "accessory": worn,
            "action": does == action,
            "sides": side == wanted_side if wanted_side and does == action else math.nan,
        }
    return {name: float(value) for name, value in rights.items()}


def most_probable_pattern(found: dict[str, Tensor]) -> tuple[str, str, str]:
    """Return the most probable pattern, and the most probable two colours with it, among the
    combinations that objects have: two different colours, or plain with "none" as the second one.

    The probability of a combination is the product of the three, averaged over the views."""
    pattern, color, second = (found[name].mean(dim=0) for name in ("pattern", "color", "second"))
    plain = torch.tensor([[[name == "plain"]] for name in LABELS["pattern"]])
    none = torch.tensor([name == "none" for name in LABELS["second"]])
    different = torch.tensor([[a != b for b in LABELS["second"]] for a in LABELS["color"]])
    possible = (plain == none) & different
    joint = pattern[:, None, None] * color[:, None] * second * possible
    chosen = int(joint.sum(dim=(1, 2)).argmax())
    first, other = divmod(int(joint[chosen].argmax()), len(second))
    return LABELS["pattern"][chosen], LABELS["color"][first], LABELS["second"][other]


def multi_face(found: dict[str, Tensor], wanted: Attributes) -> float:
    """Return the share of :func:`views` that look like another quadrant's; NaN without a front."""
    if wanted.kind in ALIKE_FROM_ALL_SIDES:
        return math.nan
    sides = torch.arange(4).repeat_interleave(len(OFFSETS_DEG))
    return float((found["quadrant"].argmax(dim=-1) != sides).float().mean())
