"""Prompt processors of models with several text encoders: ``gaussiandreamer-stable-diffusion-xl-``
and ``gaussiandreamer-stable-diffusion-3-prompt-processor``.

Options: those of ``prompt_processors.py``. An embedding contains the tokens of all encoders and, as
its last token, the pooled embedding (``models/text_encoders.py``). In addition:

===============  ===================================================================================
option           meaning
===============  ===================================================================================
negative_prompt  if it is empty, Stable Diffusion XL gets zeros, as it was trained with (where the
                 model says so, which all published ones do)
use_t5           Stable Diffusion 3: false leaves out the third encoder, T5 (4.8 billion
                 parameters); long prompts are followed less closely
===============  ===================================================================================
"""

from dataclasses import dataclass
from pathlib import Path

from jaxtyping import Float
from torch import Tensor

from ..host import register
from ..models.families import STABLE_DIFFUSION_3 as SD3_FAMILY
from ..models.families import STABLE_DIFFUSION_XL as SDXL_FAMILY
from ..models.model_files import pipeline_settings
from ..models.text_encoders import encode_sd3, encode_sd3_without_t5, encode_sdxl
from .prompt_processors import TextEncoderPromptProcessor

STABLE_DIFFUSION_XL = "stabilityai/stable-diffusion-xl-base-1.0"
STABLE_DIFFUSION_3 = "stabilityai/stable-diffusion-3.5-medium"
CLIPS = ("tokenizer", "text_encoder", "tokenizer_2", "text_encoder_2")


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
        # zeros are what the published models were trained with
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
            self.components, self.encode = CLIPS, encode_sd3_without_t5
        super().configure()
