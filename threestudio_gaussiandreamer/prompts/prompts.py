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
from typing import List, NoReturn, Optional

from ..core.errors import UserError
from ..core.files import existing_file
from ..host import BaseObject, register

DIRECTIONS = ("side", "front", "back", "overhead")
"""The view directions in the order of threestudio's view-dependent prompts."""
MAX_PROMPT_BYTES = 1 << 20


@dataclass(frozen=True)
class PlainPrompt:
    """The output of the prompt processor: texts without embeddings."""

    prompt: str
    negative_prompt: str = ""

    @property
    def prompts_vd(self) -> List[str]:
        """Prompts with each of ``DIRECTIONS``: "a fox, side view", ..."""
        return [f"{self.prompt}, {direction} view" for direction in DIRECTIONS]

    def get_text_embeddings(self, *args: object, **kwargs: object) -> NoReturn:
        """Raise UserError: a guidance that needs embeddings needs another prompt processor."""
        raise UserError(
            "plain-prompt-processor has no text encoder, but the guidance asks for text "
            "embeddings: "
            "set system.prompt_processor_type to the processor of that guidance, for instance "
            "stable-diffusion-prompt-processor."
        )


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
        prompt = (
            self.cfg.prompt if self.cfg.prompt_file is None else read_prompt(self.cfg.prompt_file)
        )
        self._prompt = PlainPrompt(prompt=prompt, negative_prompt=self.cfg.negative_prompt)

    def __call__(self) -> PlainPrompt:
        return self._prompt


def read_prompt(path: str) -> str:
    """Read a prompt file verbatim, except for one line break at its end.

    Raises:
        UserError: the file is missing, isn't UTF-8, or is larger than ``MAX_PROMPT_BYTES``.
    """
    file = existing_file(path, "prompt file (system.prompt_processor.prompt_file)")
    try:
        with open(file, "rb") as opened:
            content = opened.read(MAX_PROMPT_BYTES + 1)
        text = content.decode("utf-8-sig")
    except OSError as error:
        raise UserError(
            f"cannot read the prompt file {str(file)!r}: {error.strerror or error}."
        ) from error
    except UnicodeDecodeError as error:
        raise UserError(
            f"the prompt file {str(file)!r} is not UTF-8 text (byte {error.start})."
        ) from error
    if len(content) > MAX_PROMPT_BYTES:
        raise UserError(
            f"the prompt file {str(file)!r} has more than {MAX_PROMPT_BYTES} bytes: is it the "
            "right file?"
        )
    return text.removesuffix("\n").removesuffix("\r")
