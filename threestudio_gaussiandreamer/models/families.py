"""Families of text-to-image models in diffusers' format: which one a folder holds, and which parts
of this package take it.

The family is read from the settings of the network that predicts the noise, since the class of the
pipeline in ``model_index.json`` is missing or another one in many fine-tuned models. A model on the
hub is known by the names of its files until it is downloaded."""

import contextlib
import json
from collections.abc import Collection
from pathlib import Path
from typing import Any, NamedTuple, Optional

from ..core.errors import UserError


class Family(NamedTuple):
    """Models of the same components and inputs."""

    title: str
    parts: str
    """Name of the guidance and of the prompt processor, without prefix and suffix."""
    config: str
    """The configuration that uses them."""
    processor: str = ""
    """Name of the prompt processor, where it isn't ``parts``."""

    def __str__(self) -> str:
        processor = f"{self.processor or self.parts}-prompt-processor"
        return (
            f"{self.title}, which --config {self.config} uses "
            f"(system.guidance_type=gaussiandreamer-{self.parts}-guidance and "
            f"system.prompt_processor_type=gaussiandreamer-{processor})"
        )


STABLE_DIFFUSION = Family("Stable Diffusion 1.x or 2.x", "stable-diffusion", "gaussiandreamer.yaml")
STABLE_DIFFUSION_XL = Family(
    "Stable Diffusion XL", "stable-diffusion-xl", "gaussiandreamer-sdxl.yaml"
)
STABLE_DIFFUSION_3 = Family("Stable Diffusion 3", "stable-diffusion-3", "gaussiandreamer-sd3.yaml")
DEEP_FLOYD = Family("DeepFloyd IF", "deep-floyd", "gaussiandreamer-if.yaml")
MULTI_VIEW = Family(
    "MVDream", "mvdream", "gaussiandreamer-mvdream.yaml", processor="stable-diffusion"
)
FAMILIES = (STABLE_DIFFUSION, STABLE_DIFFUSION_XL, STABLE_DIFFUSION_3, DEEP_FLOYD, MULTI_VIEW)
SAME_FILES = (STABLE_DIFFUSION, MULTI_VIEW)
"""Families whose models have files of the same names."""


def require_family(family: Optional[Family], folder: Path) -> None:
    """Raise UserError if ``folder`` holds a model of another family, or of one that no guidance
    takes. Folders without the settings of a network pass, since their missing files are reported
    elsewhere; None accepts any.
    """
    settings = _network_settings(folder)
    if family is None or not settings:
        return
    found = family_of(settings)
    if found != family:
        known = ", ".join(each.title for each in FAMILIES)
        other = f"a {settings.get('_class_name')}, which no guidance takes; those that are taken: "
        raise UserError(
            f"the model in {str(folder)!r} isn't {family.title}, but {found or other + known}"
        )


def family_of(settings: dict[str, Any]) -> Optional[Family]:
    """Return the family of the network with these settings; None if it is none of ``FAMILIES``."""
    name = settings.get("_class_name", "UNet2DConditionModel")
    if name == "UNet2DConditionModel":
        if settings.get("addition_embed_type") == "text_time":
            return STABLE_DIFFUSION_XL
        in_pixels = settings.get("addition_embed_type"), settings.get("in_channels")
        return DEEP_FLOYD if in_pixels[0] == "text" or in_pixels[1] == 3 else STABLE_DIFFUSION
    if name == "MultiViewUNetModel":
        # ImageDream's network also takes a picture, through ip_dim tokens
        return None if settings.get("ip_dim") else MULTI_VIEW
    return STABLE_DIFFUSION_3 if name == "SD3Transformer2DModel" else None


def require_names(family: Optional[Family], names: Collection[str]) -> None:
    """Raise UserError if the file names of a model show that it is of another family."""
    components, found = {name.split("/")[0] for name in names if "/" in name}, family
    if family is None:
        return
    if "transformer" in components:
        found = STABLE_DIFFUSION_3 if "text_encoder_3" in components else family
    elif "unet" in components and "text_encoder_2" in components:
        found = STABLE_DIFFUSION_XL
    elif "unet" in components:
        found = STABLE_DIFFUSION if "vae" in components else DEEP_FLOYD
    if found != family and not {found, family} <= set(SAME_FILES):
        raise UserError(f"it isn't {family.title}, but {found}")


def _network_settings(folder: Path) -> dict[str, Any]:
    for component in ("transformer", "unet"):
        # missing or damaged ones are reported by what loads them
        with contextlib.suppress(OSError, ValueError):
            settings = json.loads((folder / component / "config.json").read_text(encoding="utf-8"))
            if isinstance(settings, dict):
                return settings
    return {}
