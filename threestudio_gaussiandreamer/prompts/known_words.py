"""Warn about words of a prompt that a model with a small vocabulary wasn't trained on.

A model may list the words that it was trained on in ``tokenizer/words.txt``; published models have
no such file, so that no prompt causes a warning.
"""

import re
from collections.abc import Collection
from difflib import get_close_matches
from pathlib import Path

WORDS_FILE = "tokenizer/words.txt"
SHOWN = 8
"""Largest number of words that the warning names."""


def warn_of_unknown_words(folder: Path, prompt: str) -> None:
    """Warn if the model in ``folder`` lists its words and the prompt has others.

    The warning names the first unknown words, each with the known ones that are spelled alike.
    """
    path = folder / WORDS_FILE
    if not path.is_file():
        return
    known = path.read_text(encoding="utf-8", errors="replace").split()
    unknown = unknown_words(prompt, known)
    if unknown:
        from ..host import warn  # brings Lightning, which readers of WORDS_FILE don't need

        shown = ", ".join(_with_near(word, known) for word in unknown[:SHOWN])
        more = f" and {len(unknown) - SHOWN} more" if len(unknown) > SHOWN else ""
        warn(
            f"the model wasn't trained on {shown}{more}: it ignores or misreads them; its "
            f"{len(known)} words are in {path}"
        )


def unknown_words(prompt: str, known: Collection[str]) -> list[str]:
    """Return the words and digits of a prompt that aren't in ``known``, in order, each once."""
    words, known = re.findall(r"[^\W\d_]+|\d", prompt.lower()), set(known)
    return list(dict.fromkeys(word for word in words if word not in known))


def _with_near(word: str, known: Collection[str]) -> str:
    near = get_close_matches(word, known, n=2)
    shown = word if len(word) <= 40 else word[:37] + "..."
    return f"{shown!r} (near: {', '.join(near)})" if near else repr(shown)
