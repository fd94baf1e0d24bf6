"""``plain-prompt-processor``: the prompt as text, for guidances that need no text encoder.

===============  ===================================================================================
option           meaning
===============  ===================================================================================
prompt           the text
prompt_file      a UTF-8 file whose content is the prompt, except for one line break at its end;
                 in place of ``prompt``. Nothing in it needs to be quoted
negative_prompt  passed on to the guidance as text; this package's guidances don't read it
===============  ===================================================================================
"""

from dataclasses import dataclass
from typing import Any, List, Optional

from ..core.errors import UserError
from ..core.files import existing_file
from ..host import BaseObject, register

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
    """Read a prompt file verbatim, except for one line break at its end; raise UserError if it is
    missing or isn't UTF-8.
    """
    file = existing_file(path, "prompt file (system.prompt_processor.prompt_file)")
    try:
        text = file.read_bytes().decode("utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        said = f"the prompt file {str(file)!r} can't be read as UTF-8 text"
        raise UserError(f"{said}: {error}") from error
    return text.removesuffix("\n").removesuffix("\r")
