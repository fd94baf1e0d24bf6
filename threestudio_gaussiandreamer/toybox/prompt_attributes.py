"""Read the attributes that a prompt asks for, the inverse of ``words.describe``."""

import re
from collections.abc import Iterable, Mapping
from typing import NamedTuple, Optional

from .words import ACCESSORY_WORDS, COLOR_WORDS, NOUNS, PARTS
from .world import COLORS, Attributes

PATTERN_WORDS: dict[str, tuple[str, ...]] = {
    "striped": ("striped", "stripes"),
    "dotted": ("dotted", "dots", "spotted", "spots"),
    "checkered": ("checkered", "checks"),
    "two-tone": ("two tone", "top", "above"),
}


class Word(NamedTuple):
    """The meaning of a word, or of a phrase such as "light green"."""

    role: str
    """kind, color, pattern, part or accessory."""
    meaning: str


def attributes_in(prompt: str) -> Optional[Attributes]:
    """Return the attributes that a prompt names; None if it names no kind of object or no colour.

    The colour directly in front of a part or an accessory belongs to that. Of the other colours the
    first is the body's and the second the pattern's. A pattern without a second colour is ignored,
    as are unknown words.
    """
    words = _meanings(prompt)
    kind = next((word.meaning for word in words if word.role == "kind"), None)
    part = _colored(words, "part", PARTS[kind] if kind else "")
    accessory = _colored(words, "accessory")
    taken = {place for place, _, _ in (part, accessory) if place is not None}
    colors = [w.meaning for i, w in enumerate(words) if w.role == "color" and i not in taken]
    if kind is None or not colors:
        return None
    patterns = [word.meaning for word in words if word.role == "pattern"]
    pattern = patterns[0] if patterns and len(colors) > 1 else "plain"
    return Attributes(
        kind=kind,
        color=colors[0],
        pattern=pattern,
        second=colors[1] if pattern != "plain" else None,
        part=part[2],
        accessory=accessory[1],
        accessory_color=accessory[2],
    )


def _words(prompt: str) -> list[str]:
    return re.findall(r"[^\W_]+", prompt.lower())


def _meanings(prompt: str) -> list[Word]:
    """Return the known words in order; of those that begin at one place, the longest."""
    text, found, at = " ".join(_words(prompt)), [], 0
    while at < len(text):
        phrase = next((p for p in PHRASES if _stands_at(text, p, at)), None)
        if phrase:
            found.append(MEANINGS[phrase])
        at = text.find(" ", at + len(phrase or "")) + 1 or len(text)
    return found


def _stands_at(text: str, phrase: str, at: int) -> bool:
    return text.startswith(phrase, at) and text[at + len(phrase) : at + len(phrase) + 1] in (
        "",
        " ",
    )


def _colored(
    words: list[Word], role: str, meaning: str = ""
) -> tuple[Optional[int], Optional[str], Optional[str]]:
    """Find the first word of a role, and of this meaning if one is given, with a colour before it.

    Returns:
        the colour's index in ``words``, the word's meaning and its colour; three None if none is
        found.
    """
    for place, (color, word) in enumerate(zip(words, words[1:], strict=False)):
        if word.role == role and color.role == "color" and meaning in ("", word.meaning):
            return place, word.meaning, color.meaning
    return None, None, None


def _synonyms(role: str, words: Mapping[str, Iterable[str]]) -> dict[str, Word]:
    return {word: Word(role, meaning) for meaning, same in words.items() for word in same}


MEANINGS: dict[str, Word] = (
    {color: Word("color", color) for color in COLORS}
    | _synonyms("color", COLOR_WORDS)
    | _synonyms("kind", NOUNS)
    | _synonyms("accessory", ACCESSORY_WORDS)
    | _synonyms("pattern", PATTERN_WORDS)
    | {part: Word("part", part) for part in PARTS.values()}
)
PHRASES = sorted(MEANINGS, key=len, reverse=True)
