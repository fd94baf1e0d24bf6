"""What the runs of benchmarks/quality/toybox.py are made of: variants of configs/toybox.yaml, which
toybox_options.py lists, prompts, and digests of what every run depends on.
"""

import functools
import hashlib
from pathlib import Path
from typing import Any, NamedTuple

import yaml

from benchmarks.quality.runs import ROOT
from threestudio_gaussiandreamer.core.streams import numpy_generator
from threestudio_gaussiandreamer.models.bundled import (
    FOLDER,
    JUDGE,
    NAME,
    RECORD,
    digest_of,
    model_part,
    read_digests,
)
from threestudio_gaussiandreamer.toybox import recognition
from threestudio_gaussiandreamer.toybox.words import describe
from threestudio_gaussiandreamer.toybox.world import VERSION, Attributes, draw_attributes

CHART = "toybox"
GPU_CHART = "toybox_gpu"
"""Of runs on a GPU, whose networks compute in float16."""
ATTRIBUTES = ("kind", "colors", "pattern", "accessory")
RECOGNIZED = (*ATTRIBUTES, "multi_face")
"""Columns of what the judge finds in a result."""
CONFIG = yaml.safe_load((ROOT / "configs/toybox.yaml").read_text())
STEPS = CONFIG["trainer"]["max_steps"]
GUIDANCE = CONFIG["system"]["guidance"]["guidance_scale"]
DEFAULT, PAPER_RECIPE = "toybox.yaml", "the paper's recipe"
RANDOM_STARTS = "grey ball", "grey ball, no view prompts"
SAMPLES, TRUTH = "the 2D model's samples", "ground truth"
"""Variants without a run: what the 2D model draws, and ray-cast views of the object itself."""
EXACT = "exact score of the object"
"""A variant whose guidance knows the views of the object, in place of the 2D model."""
WORLD = f"world {VERSION}"
"""What the views of the objects themselves depend on."""
MODELS_BESIDE_GUIDANCE = (
    "system.prompt_processor.pretrained_model_name_or_path",
    "system.geometry.prior.checkpoint",
    "system.geometry.prior.clip",
)
"""The options that take the models from the guidance, for one without models."""
PROMPT_SEED = 5000
"""Of the attributes and words of prompts; trainings use others."""


class Variant(NamedTuple):
    """One kind of run."""

    name: str
    x: float = 0.0
    """The number that a chart varies; 0 if it varies none."""
    options: dict[str, Any] = {}
    config: str = DEFAULT

    @property
    def key(self) -> tuple[str, str]:
        return self.name, f"{self.x:g}"


class Prompt(NamedTuple):
    text: str
    index: int
    withheld: bool
    attributes: Attributes


@functools.cache
def setup(models: str = NAME, config: str = DEFAULT) -> str:
    """Return a digest of what every run depends on: its configuration, and the networks but the
    judge.

    Args:
        models: "toybox", or the folder of an export.
    """
    content = yaml.safe_load((ROOT / "configs" / config).read_text())
    return digest((content, networks(models)))


@functools.cache
def setup_of_samples(models: str = NAME) -> str:
    """Return what the 2D model's own samples depend on: a digest of the networks but the judge."""
    return f"models {digest(networks(models))}"


@functools.cache
def judge_of(models: str = NAME) -> str:
    """Return what every score depends on beside the pictures: a digest of the judge's file, and the
    version of how its probabilities are read.
    """
    path = Path(model_part(models, JUDGE)).expanduser()
    digest = digest_of(path)[:8] if path.is_file() else "none"
    return f"{digest} reading {recognition.VERSION}"


def networks(models: str) -> list[tuple[str, str]]:
    """Return the files of all networks but the judge, and their digests."""
    folder = FOLDER if models == NAME else Path(models).expanduser()
    digests = read_digests(folder) or {models: ""}
    return sorted(item for item in digests.items() if item[0] not in (JUDGE, RECORD))


def digest(content: Any) -> str:
    return hashlib.blake2b(repr(content).encode(), digest_size=4).hexdigest()


def prompts(sort: str, count: int) -> list[Prompt]:
    """Write prompts for objects that no training saw.

    Args:
        sort: "withheld": combinations of attributes that all trainings leave out, but persons;
            "persons": persons of such combinations; "seen": other objects, on which settings are
            chosen.
    """
    held_out, share = sort != "seen", float(sort == "persons")
    found: list[Prompt] = []
    for index in range(count):
        made = draw_attributes(PROMPT_SEED, index, held_out=held_out, person_share=share)
        rng = numpy_generator(PROMPT_SEED, "benchmark-prompt", int(held_out), index)
        found.append(Prompt(describe(made, rng), index, held_out, made))
    return found
