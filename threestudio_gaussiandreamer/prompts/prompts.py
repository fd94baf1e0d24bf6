"""``plain-prompt-processor``: the prompt as text, for guidances that need no text encoder; and the
warning of words that a model with a small vocabulary wasn't trained on.

===============  ===================================================================================
option           meaning
===============  ===================================================================================
prompt           the text
prompt_file      a UTF-8 file whose content is the prompt, except for one line break at its end;
                 in place of ``prompt``. Nothing in it needs to be quoted
negative_prompt  passed on to the guidance as text; this package's guidances don't read it
===============  ===================================================================================
"""

import re
from collections.abc import Collection
from dataclasses import dataclass
from difflib import get_close_matches
from pathlib import Path
from typing import Any, List, Optional

from ..core.errors import UserError
from ..formats.reading import Unreadable, reading
from ..host import BaseObject, register, warn
from ..models.bundled import WORDS_FILE

DIRECTIONS = ("side", "front", "back", "overhead")
"""The view directions in the order of threestudio's view-dependent prompts."""


@dataclass(frozen=True)
class PlainPrompt:
    """The output of the prompt processor: texts without embeddings."""

    prompt: str
    negative_prompt: str = ""

    @property
    def prompts_vd(self) -> List[str]:
        """Prompts with each of ``DIRECTIONS``: "a fox, side view", ..."""
        return [f"{self.prompt}, {direction} view" for direction in DIRECTIONS]


@register("plain-prompt-processor")
class PlainPromptProcessor(BaseObject):
    """Hold the prompt as text; a call returns a :class:`PlainPrompt`."""

    @dataclass
    class Config(BaseObject.Config):
        prompt: str = ""
        prompt_file: Optional[str] = None
        negative_prompt: str = ""

    cfg: Config

    def configure(self) -> None:
        if self.cfg.prompt and self.cfg.prompt_file is not None:
            raise UserError("both prompt and prompt_file are set: give one of them")
        self._prompt = PlainPrompt(given_prompt(self.cfg), self.cfg.negative_prompt)

    def __call__(self) -> PlainPrompt:
        return self._prompt


def given_prompt(cfg: Any) -> str:
    """Return the prompt that the options of a processor give as text or as a file."""
    return cfg.prompt if cfg.prompt_file is None else read_prompt(cfg.prompt_file)


def read_prompt(path: str) -> str:
    """Read a file verbatim but for a last line break; UserError if missing or not UTF-8."""
    with reading(path, "prompt file (system.prompt_processor.prompt_file)") as file:
        try:
            text = file.read_bytes().decode("utf-8-sig")
        except UnicodeDecodeError as error:
            raise Unreadable(f"it isn't UTF-8 text ({error})") from error
    return text.removesuffix("\n").removesuffix("\r")


# Words that a model wasn't trained on -------------------------------------------------------------

SHOWN = 8
"""Largest number of words that the warning names."""


def warn_of_unknown_words(folder: Path, prompt: str) -> None:
    """Warn if the model in ``folder`` lists its words and the prompt has others: of the first ones,
    each with the known ones that are spelled alike.
    """
    path = folder / WORDS_FILE
    if not path.is_file():
        return
    known = path.read_text(encoding="utf-8", errors="replace").split()
    words = re.findall(r"[^\W\d_]+|\d", prompt.lower())
    unknown = list(dict.fromkeys(word for word in words if word not in known))
    if unknown:
        shown = ", ".join(_with_near(word, known) for word in unknown[:SHOWN])
        more = f" and {len(unknown) - SHOWN} more" if len(unknown) > SHOWN else ""
        warn(
            f"the model wasn't trained on {shown}{more}: it ignores or misreads them; its "
            f"{len(known)} words are in {path}"
        )


def _with_near(word: str, known: Collection[str]) -> str:
    near = get_close_matches(word, known, n=2)
    shown = word if len(word) <= 40 else word[:37] + "..."
    return f"{shown!r} (near: {', '.join(near)})" if near else repr(shown)
