"""Prompts for the toybox's objects: synonyms, templates, and view directions in the form of the
prompt processors; and the inverse, the attributes that a prompt asks for."""

import re
from collections.abc import Iterable, Mapping
from typing import Optional

import numpy as np

from ..priors.motion_text import plain
from ..prompts.view_prompts import view_directions
from . import motions
from .world import COLORS, Attributes

NOUNS: dict[str, tuple[str, ...]] = {
    "fox": ("fox", "vixen"), "rabbit": ("rabbit", "bunny", "hare"),
    "bear": ("bear", "teddy bear", "teddy"), "duck": ("duck", "duckling"),
    "elephant": ("elephant",), "penguin": ("penguin",), "turtle": ("turtle", "tortoise"),
    "car": ("car", "automobile"), "truck": ("truck", "lorry"),
    "boat": ("boat", "sailing boat", "ship"), "plane": ("plane", "airplane", "aeroplane"),
    "house": ("house", "cottage", "hut"), "mug": ("mug", "cup"), "chair": ("chair", "seat"),
    "mushroom": ("mushroom", "toadstool"), "robot": ("robot", "android"),
    "person": ("person", "man", "woman"),
}  # fmt: skip
COLOR_WORDS: dict[str, tuple[str, ...]] = {
    "red": ("red", "scarlet", "crimson"), "lime": ("lime", "light green"),
    "green": ("green", "dark green"), "teal": ("teal", "turquoise", "cyan"),
    "blue": ("blue", "navy"), "purple": ("purple", "violet"), "pink": ("pink", "rose"),
    "yellow": ("yellow", "golden"),
}  # fmt: skip
"""Synonyms of colours; colours that aren't listed have none."""
PARTS: dict[str, str] = {
    "fox": "ears and tail", "rabbit": "ears", "bear": "belly", "duck": "wings", "elephant": "ears",
    "penguin": "belly", "turtle": "legs", "car": "roof", "truck": "trailer", "boat": "sail",
    "plane": "wings", "house": "roof", "mug": "handle", "chair": "cushion", "mushroom": "stem",
    "robot": "head", "person": "trousers",
}  # fmt: skip
"""The word for the role "part" of each kind."""
ACCESSORY_WORDS: dict[str, tuple[str, ...]] = {
    "hat": ("hat", "cap"), "scarf": ("scarf", "ribbon"), "flag": ("flag", "banner"),
    "balloon": ("balloon",), "cape": ("cape", "cloak"),
}  # fmt: skip
CLOTHES = {"shirt": ("shirt", "jacket"), "trousers": ("trousers", "pants")}
"""Words of a person's upper and lower half."""
OPENINGS = *["a {}"] * 3, "a toy {}", "a small {}", "a photo of a {}", "a 3d model of a {}", "{}"
"""Templates for the object's description; "a {}" is drawn most often."""
OPPOSITE = {"front": "back", "back": "front", "overhead": "overhead"}
OPPOSITE |= {"left side": "right side", "right side": "left side"}
"""The directions of views, each with the opposite one."""
DIRECTIONS = view_directions(left_and_right=True)
EMPTY_SHARE, PLAIN_SHARE, PREFIX_SHARE, UNNAMED_SIDE_SHARE = 0.1, 0.2, 0.04, 0.1
"""Shares of prompts that are empty, that name no direction, and that begin with it; and of the side
views, of prompts that say "side view", as threestudio's do."""


def direction(elevation: float, azimuth: float) -> str:
    """Name the direction of a view (degrees), as with ``view_dependent_left_and_right``."""
    view = float(elevation), float(azimuth), 0.0
    return next(way.name for way in reversed(DIRECTIONS) if way.condition(*view))


def describe(attributes: Attributes, rng: np.random.Generator) -> str:
    """Write a prompt for the object, without a direction."""
    if attributes.action:
        return _describe_person(attributes, rng)
    noun = _pick(NOUNS[attributes.kind], rng)
    color = _color(attributes.color, rng)
    opening = _pick(OPENINGS, rng)
    if attributes.second:
        second = _color(attributes.second, rng)
        phrase = _pick(PATTERN_PHRASES[attributes.pattern], rng)
        text = opening.format(phrase.format(c=color, s=second, n=noun))
    else:
        text = opening.format(f"{color} {noun}")
    if attributes.part:
        name = PARTS[attributes.kind]
        article = "" if name.startswith(("ears", "wings", "legs")) else "a "
        joint = "and" if " with " in text else "with"
        text = f"{text} {joint} {article}{_color(attributes.part, rng)} {name}"
    if attributes.accessory:
        name = _pick(ACCESSORY_WORDS[attributes.accessory], rng)
        verb = "wearing" if name in ("hat", "cap", "scarf") and rng.random() < 0.25 else "with"
        joint = " and" if " with " in text and verb == "with" else f" {verb}"
        text = f"{text}{joint} a {_color(attributes.accessory_color, rng)} {name}"
    return re.sub(r"\ba (?=[aeio])", "an ", text)


def _describe_person(a: Attributes, rng: np.random.Generator) -> str:
    """Write "a person in a red shirt and blue trousers kicks with the left leg"."""
    upper, lower = (_pick(words, rng) for words in CLOTHES.values())
    worn = [f"a {_color(a.color, rng)} {upper}", f"{_color(a.part, rng)} {lower}"]
    if a.accessory:
        name = _pick(ACCESSORY_WORDS[a.accessory], rng)
        worn.insert(int(rng.integers(3)), f"a {_color(a.accessory_color, rng)} {name}")
    dressed = f"{', '.join(worn[:-1])} and {worn[-1]}"
    subject = _pick(OPENINGS, rng).format(_pick(NOUNS[a.kind], rng))
    does = motion_of(a.action, rng)
    clothes = f"{_pick(('in', 'in', 'wearing'), rng)} {dressed}"
    first, last = (does, clothes) if rng.random() < 0.25 else (clothes, does)
    return re.sub(r"\ba (?=[aeio])", "an ", f"{subject} {first} {last}")


def motion_of(action: str, rng: np.random.Generator) -> str:
    """Write what a person does: "kicks with the left leg", "kicking the left leg"."""
    phrase = _pick(_phrases(action), rng)
    return _progressive(phrase) if rng.random() < 0.25 else phrase


def _phrases(action: str) -> tuple[str, ...]:
    name, side = motions.split(action)
    return tuple(phrase.format(side) for phrase in motions.ACTIONS[name].phrases)


def _progressive(phrase: str) -> str:
    verb, space, rest = phrase.partition(" ")
    return f"{PROGRESSIVE[verb]}{space}{rest}"


PROGRESSIVE = {
    "stands": "standing", "opens": "opening", "is": "standing", "holds": "holding",
    "raises": "raising", "lifts": "lifting", "waves": "waving", "points": "pointing",
    "punches": "punching", "kicks": "kicking", "walks": "walking", "runs": "running",
    "sits": "sitting", "squats": "squatting", "crouches": "crouching", "jumps": "jumping",
    "bows": "bowing", "takes": "taking",
}  # fmt: skip
ACTION_PHRASES: dict[str, str] = {
    form: action
    for action in motions.names()
    for phrase in _phrases(action)
    for form in (phrase, _progressive(phrase))
}
"""The action of each phrase, in both forms of its verb."""


def prompt_of(a: Attributes, elevation: float, azimuth: float, rng: np.random.Generator) -> str:
    """Write a view's prompt: empty, without a direction, or with it as prompt processors do."""
    share = rng.random()
    if share < EMPTY_SHARE:
        return ""
    text, view = describe(a, rng), direction(elevation, azimuth)
    if share < EMPTY_SHARE + PLAIN_SHARE:
        return text
    if view.endswith("side") and rng.random() < UNNAMED_SIDE_SHARE:
        view = "side"
    if share < EMPTY_SHARE + PLAIN_SHARE + PREFIX_SHARE:
        return f"{'backside' if view == 'back' else view} view of {text}"
    return f"{text}, {view} view"


def vocabulary() -> list[str]:
    """Return all words that occur in prompts, sorted."""
    named = [*NOUNS.values(), *COLOR_WORDS.values(), *ACCESSORY_WORDS.values()]
    phrases = [*COLORS, *PARTS.values(), *OPENINGS, *(word for n in named for word in n)]
    phrases += [*OPPOSITE, "backside view of , an with and wearing half below above bottom top"]
    phrases += ["someone in", *CLOTHES["shirt"], *CLOTHES["trousers"], *ACTION_PHRASES]
    phrases += ["two tone striped stripes dotted dots spots polka spotted checkered checks"]
    return sorted(set(re.findall(r"[a-z]+|\d|,", " ".join(phrases))))


DOTS = "{c} {n} with {s} dots", "{c} {n} with {s} spots", "{c} {n} with {s} polka dots"
PATTERN_PHRASES: dict[str, tuple[str, ...]] = {
    "striped": ("{c} {n} with {s} stripes", "{c} and {s} striped {n}", "striped {c} and {s} {n}"),
    "dotted": (*DOTS, "{c} {n} dotted with {s}"),
    "checkered": ("{c} and {s} checkered {n}", "{c} {n} with {s} checks",
                  "checkered {c} and {s} {n}"),
    "two-tone": ("two tone {n}, {c} below and {s} above", "{n} with {c} bottom and {s} top"),
}  # fmt: skip


def _color(color: str, rng: np.random.Generator) -> str:
    return _pick(COLOR_WORDS.get(color, (color,)), rng) if rng.random() < 0.4 else color


def _pick(choices: tuple[str, ...], rng: np.random.Generator) -> str:
    return choices[int(rng.integers(len(choices)))]


PATTERN_WORDS: dict[str, tuple[str, ...]] = {
    "striped": ("striped", "stripes"), "dotted": ("dotted", "dots", "spotted", "spots"),
    "checkered": ("checkered", "checks"), "two-tone": ("two tone", "top", "above"),
}  # fmt: skip


Word = tuple[str, str]
"""The role (kind, color, part, ...) and the meaning of a word, or of a phrase as "light green"."""


def attributes_in(prompt: str) -> Optional[Attributes]:
    """Return the attributes that a prompt names; None if it names no kind of object or no colour.

    The colour directly in front of a part or an accessory belongs to that. Of the other colours the
    first is the body's and the second the pattern's. A pattern without a second colour is ignored.
    """
    words = _meanings(prompt)
    kind, action = (next((m for role, m in words if role == of), None) for of in ("kind", "action"))
    part = _colored(words, "part", PARTS.get(kind, ""))
    accessory = _colored(words, "accessory")
    if action and kind == "person":
        shirt = _colored(words, "shirt")[2]
        clothes = part[2] or shirt, *accessory[1:]
        return shirt and Attributes(kind, shirt, "plain", None, *clothes, action)
    rest = [word for i, word in enumerate(words) if i not in (part[0], accessory[0])]
    colors, patterns = ([m for role, m in rest if role == of] for of in ("color", "pattern"))
    if kind is None or not colors:
        return None
    plain = not patterns or len(colors) < 2
    pattern, second = ("plain", None) if plain else (patterns[0], colors[1])
    return Attributes(kind, colors[0], pattern, second, part[2], *accessory[1:])


def _meanings(prompt: str) -> list[Word]:
    """Return the known words in order; of those that begin at one place, the longest."""
    text, found = plain(prompt)[1:], []
    while text:
        phrase = next((p for p in PHRASES if text.startswith(f"{p} ")), "")
        if phrase:
            found.append(MEANINGS[phrase])
        text = text[len(phrase) :].lstrip() if phrase else text.partition(" ")[2]
    return found


def _colored(
    words: list[Word], role: str, meaning: str = ""
) -> tuple[Optional[int], Optional[str], Optional[str]]:
    """Find the first word of a role, and of this meaning if one is given, with a colour before it;
    return the colour's index in ``words``, the word's meaning and its colour, or three None."""
    pairs = enumerate(zip(words, words[1:], strict=False))
    for place, ((before, color), (word, found)) in pairs:
        if word == role and before == "color" and meaning in ("", found):
            return place, found, color
    return None, None, None


def _synonyms(role: str, words: Mapping[str, Iterable[str]]) -> dict[str, Word]:
    return {word: (role, meaning) for meaning, same in words.items() for word in same}


MEANINGS: dict[str, Word] = (
    {color: ("color", color) for color in COLORS}
    | _synonyms("color", COLOR_WORDS)
    | _synonyms("kind", NOUNS)
    | _synonyms("accessory", ACCESSORY_WORDS)
    | _synonyms("pattern", PATTERN_WORDS)
    | {part: ("part", part) for part in PARTS.values()}
    | dict.fromkeys(CLOTHES["shirt"], ("shirt", "shirt"))
    | dict.fromkeys(CLOTHES["trousers"], ("part", "trousers"))
    | {plain(phrase).strip(): ("action", action) for phrase, action in ACTION_PHRASES.items()}
)
PHRASES = sorted(MEANINGS, key=len, reverse=True)
