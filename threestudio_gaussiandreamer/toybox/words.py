"""Prompts for the toybox's objects: synonyms, templates, and view directions in the form of the
prompt processors.
"""

import re
from collections.abc import Iterator

import numpy as np

from .world import COLORS, Attributes

NOUNS: dict[str, tuple[str, ...]] = {
    "fox": ("fox", "vixen"),
    "rabbit": ("rabbit", "bunny", "hare"),
    "bear": ("bear", "teddy bear", "teddy"),
    "duck": ("duck", "duckling"),
    "elephant": ("elephant",),
    "penguin": ("penguin",),
    "turtle": ("turtle", "tortoise"),
    "car": ("car", "automobile"),
    "truck": ("truck", "lorry"),
    "boat": ("boat", "sailing boat", "ship"),
    "plane": ("plane", "airplane", "aeroplane"),
    "house": ("house", "cottage", "hut"),
    "mug": ("mug", "cup"),
    "chair": ("chair", "seat"),
    "mushroom": ("mushroom", "toadstool"),
    "robot": ("robot", "android"),
}
COLOR_WORDS: dict[str, tuple[str, ...]] = {
    "red": ("red", "scarlet", "crimson"),
    "lime": ("lime", "light green"),
    "green": ("green", "dark green"),
    "teal": ("teal", "turquoise", "cyan"),
    "blue": ("blue", "navy"),
    "purple": ("purple", "violet"),
    "pink": ("pink", "rose"),
    "yellow": ("yellow", "golden"),
}
"""Synonyms of colours; colours that aren't listed have none."""
PARTS: dict[str, str] = {
    "fox": "ears and tail",
    "rabbit": "ears",
    "bear": "belly",
    "duck": "wings",
    "elephant": "ears",
    "penguin": "belly",
    "turtle": "legs",
    "car": "roof",
    "truck": "trailer",
    "boat": "sail",
    "plane": "wings",
    "house": "roof",
    "mug": "handle",
    "chair": "cushion",
    "mushroom": "stem",
    "robot": "head",
}
"""The word for the role "part" of each kind."""
PLURALS = ("ears", "wings", "legs")
ACCESSORY_WORDS: dict[str, tuple[str, ...]] = {
    "hat": ("hat", "cap"),
    "scarf": ("scarf", "ribbon"),
    "flag": ("flag", "banner"),
    "balloon": ("balloon",),
}
OPENINGS = (
    "a {}",
    "a {}",
    "a {}",
    "a toy {}",
    "a small {}",
    "a photo of a {}",
    "a 3d model of a {}",
    "{}",
)
"""Templates for the object's description; "a {}" is drawn most often."""
OPPOSITE = {
    "front": "back",
    "back": "front",
    "left side": "right side",
    "right side": "left side",
    "overhead": "overhead",
}
"""The directions of views, each with the opposite one."""
FRONT_HALF = BACK_HALF = 45.0
OVERHEAD = 60.0
"""Thresholds of the prompt processors, degrees."""
UNNAMED_SIDE_SHARE = 0.1
"""Fraction of the side views whose prompts say "side view", as threestudio's do."""
EMPTY_SHARE, PLAIN_SHARE, PREFIX_SHARE = 0.1, 0.2, 0.04
"""Shares of prompts that are empty, that name no direction, and that name it in front ("side view
of ...").
"""


def direction(elevation: float, azimuth: float) -> str:
    """Return the direction of a view, with the prompt processors' thresholds and
    ``view_dependent_left_and_right``.

    Args:
        elevation, azimuth: degrees.
    """
    shifted = (azimuth + 180) % 360 - 180
    if elevation > OVERHEAD:
        return "overhead"
    if abs(shifted) < FRONT_HALF:
        return "front"
    if abs(shifted) > 180 - BACK_HALF:
        return "back"
    return "left side" if shifted >= 0 else "right side"


def describe(attributes: Attributes, rng: np.random.Generator) -> str:
    """Write a prompt for the object, without a direction."""
    noun = _pick(NOUNS[attributes.kind], rng)
    color = _color(attributes.color, rng)
    text = _pick(OPENINGS, rng).format(_patterned(attributes, noun, color, rng))
    if attributes.part:
        name = PARTS[attributes.kind]
        article = "" if name.startswith(PLURALS) else "a "
        text = f"{text}{_joint(text)}{article}{_color(attributes.part, rng)} {name}"
    if attributes.accessory:
        name = _pick(ACCESSORY_WORDS[attributes.accessory], rng)
        verb = "wearing" if name in ("hat", "cap", "scarf") and rng.random() < 0.25 else "with"
        joint = " and" if " with " in text and verb == "with" else f" {verb}"
        text = f"{text}{joint} a {_color(attributes.accessory_color, rng)} {name}"
    return re.sub(r"\ba (?=[aeio])", "an ", text)


def prompt_of(
    attributes: Attributes, elevation: float, azimuth: float, rng: np.random.Generator
) -> str:
    """Write a training prompt of one view.

    It is empty, names no direction, or names it as the prompt processors write it.
    """
    share = rng.random()
    if share < EMPTY_SHARE:
        return ""
    text, view = describe(attributes, rng), direction(elevation, azimuth)
    if share < EMPTY_SHARE + PLAIN_SHARE:
        return text
    if view.endswith("side") and rng.random() < UNNAMED_SIDE_SHARE:
        view = "side"
    if share < EMPTY_SHARE + PLAIN_SHARE + PREFIX_SHARE:
        return f"{'backside' if view == 'back' else view} view of {text}"
    return f"{text}, {view} view"


def vocabulary() -> list[str]:
    """Return all words that occur in prompts, sorted."""
    return sorted(set(re.findall(r"[a-z]+|\d|,", " ".join(_phrases()))))


def _phrases() -> Iterator[str]:
    yield from COLORS
    yield from (
        word
        for words in (*NOUNS.values(), *COLOR_WORDS.values(), *ACCESSORY_WORDS.values())
        for word in words
    )
    yield from (*PARTS.values(), *OPENINGS, *OPPOSITE, "backside view of , an with and wearing")
    yield "striped stripes dotted dots spots polka spotted checkered checks"
    yield "two tone half below above bottom top"


def _patterned(attributes: Attributes, noun: str, color: str, rng: np.random.Generator) -> str:
    if attributes.pattern == "plain":
        return f"{color} {noun}"
    second = _color(attributes.second, rng)
    return _pick(PATTERN_PHRASES[attributes.pattern], rng).format(c=color, s=second, n=noun)


PATTERN_PHRASES: dict[str, tuple[str, ...]] = {
    "striped": ("{c} {n} with {s} stripes", "{c} and {s} striped {n}", "striped {c} and {s} {n}"),
    "dotted": (
        "{c} {n} with {s} dots",
        "{c} {n} with {s} spots",
        "{c} {n} with {s} polka dots",
        "{c} {n} dotted with {s}",
    ),
    "checkered": (
        "{c} and {s} checkered {n}",
        "{c} {n} with {s} checks",
        "checkered {c} and {s} {n}",
    ),
    "two-tone": ("two tone {n}, {c} below and {s} above", "{n} with {c} bottom and {s} top"),
}


def _joint(text: str) -> str:
    return " and " if " with " in text else " with "


def _color(color: str, rng: np.random.Generator) -> str:
    return _pick(COLOR_WORDS.get(color, (color,)), rng) if rng.random() < 0.4 else color


def _pick(choices: tuple[str, ...], rng: np.random.Generator) -> str:
    return choices[int(rng.integers(len(choices)))]
