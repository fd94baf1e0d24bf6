"""The models in the package: complete, small, and able to do what docs/toybox.md says."""

import pytest
import yaml

from tests.toybox.test_text_to_3d import PROMPT, run
from tests.training.runs import CONFIGS
from threestudio_gaussiandreamer import register_parts
from threestudio_gaussiandreamer.evaluation.asset_metrics import Scores, result_of
from threestudio_gaussiandreamer.models.bundled import FOLDER, NAME, RECORD, digest_of, read_digests
from threestudio_gaussiandreamer.view.run_index import leaves

register_parts()
pytestmark = pytest.mark.skipif(
    not (FOLDER / RECORD).is_file(), reason="the package has no trained models yet"
)
LARGEST = 24e6
"""Bytes of all files together."""


def test_the_files_are_complete_and_small():
    digests = read_digests(FOLDER)
    assert RECORD in digests
    assert all(digest_of(FOLDER / name) == digest for name, digest in digests.items())
    files = [path for path in FOLDER.rglob("*") if path.is_file()]
    assert len(files) == len(digests) + 1
    assert sum(path.stat().st_size for path in files) <= LARGEST


@pytest.mark.slow
def test_a_whole_run_is_recognised_by_the_judge(tmp_path):
    """With the draft's options, which take fewer views for the same steps."""
    pytest.importorskip("diffusers")
    cfg = yaml.safe_load((CONFIGS / "toybox.yaml").read_text())
    prior = cfg["system"]["geometry"]["prior"]
    whole = [f"trainer.max_steps={cfg['trainer']['max_steps']}"]
    whole += [f"system.geometry.prior.{key}={prior[key]}" for key in ("num_steps", "num_points")]
    draft = leaves(yaml.safe_load((CONFIGS / "toybox-draft.yaml").read_text()))
    whole += [f"{name}={value}" for name, value in draft]
    whole += ["system.pages=false", "trainer.limit_val_batches=0"]
    whole += ["system.exporter={formats: [ply], save_video: false}"]  # what is scored
    assert run(NAME, tmp_path, PROMPT, *whole) == 0
    scores = Scores(NAME).of_asset(result_of(tmp_path / "toybox/t", PROMPT))
    assert scores["kind"] and scores["colors"]
