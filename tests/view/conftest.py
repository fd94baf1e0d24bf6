"""The folder of a run, made by hand."""

import json
from pathlib import Path

import pytest

from tests.view.clouds import cloud
from threestudio_gaussiandreamer.formats.gaussian_files import write_cloud


@pytest.fixture
def run_folder(tmp_path) -> Path:
    """A run of 7 steps with an export."""
    folder = tmp_path / "run"
    (folder / "save" / "it7-export").mkdir(parents=True)
    (folder / "configs").mkdir()
    (folder / "configs" / "parsed.yaml").write_text(
        "system:\n  renderer: {preset: fast, eps2d: 0.4, antialias: true, downsample: 2}\n"
        "  prompt_processor: {prompt: a box}\n  background: {color: [0.0, 1.0, 0.0]}\n"
        "  geometry: {bound_colors: false}\n"
    )
    scores = {"prior": {"step": 0, "psnr": 12.0}, "result": {"step": 7, "psnr": 31.25}}
    (folder / "save" / "metrics.json").write_text(json.dumps(scores))
    write_cloud(str(folder / "save" / "it7-export" / "gaussians.spz"), cloud(30))
    return folder
