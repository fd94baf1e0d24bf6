"""From a prompt to a measured cloud with learned models, tiny ones here: configs/toybox.yaml, the
scorecard of its runs, and wrong input.
"""

import csv
import json

import pytest
import yaml

from tests.training.runs import CONFIGS
from threestudio_gaussiandreamer.evaluation.scorecard import main as evaluate
from threestudio_gaussiandreamer.launch.experiment import main as launch
from threestudio_gaussiandreamer.toybox import views

PROMPT = "a red fox with a green scarf"
QUICK = [
    "trainer.max_steps=2", "trainer.enable_progress_bar=false", "system.geometry.prior.num_steps=2",
    "system.geometry.prior.num_points=40", "data.n_test_views=1", "data.eval_width=32",
    "data.eval_height=32", "use_timestamp=false", "tag=t",
]  # fmt: skip

MODEL = "system.guidance.pretrained_model_name_or_path"
pytestmark = pytest.mark.usefixtures("small_world")


def run(exported, folder, prompt, *options):
    overrides = [
        f"exp_root_dir={folder}",
        f"system.prompt_processor.prompt={prompt}",
        f"system.prompt_processor.cache_dir={folder}/cache",
        f"{MODEL}={exported}",
        *QUICK,
        *options,
    ]
    return launch(["--config", str(CONFIGS / "toybox.yaml"), "--train", "--gpu", "cpu", *overrides])


def test_cameras_and_background_are_those_of_the_training():
    cfg = yaml.safe_load((CONFIGS / "toybox.yaml").read_text())
    data, low, high = cfg["data"], *views.DISTANCE
    assert data["camera_distance_range"] == [low, high]
    assert data["elevation_range"] == list(views.ELEVATION)
    assert data["fovy_range"] == [views.FOVY_DEG] * 2 and data["width"] == views.SIZE
    assert cfg["system"]["background"]["color"] == list(views.BACKGROUND)
    assert data["eval_camera_distance"] == pytest.approx((low + high) / 2)


def test_a_prompt_becomes_a_cloud_and_its_pages_and_is_scored(exported, tmp_path, capsys):
    """With unknown words, which are named, and with the models of one folder."""
    assert run(exported, tmp_path, "a red fox with a skarf 狐狸 🦊") == 0
    assert "wasn't trained on" in (errors := capsys.readouterr().err)
    assert "'skarf' (near: scarf)" in errors and "'狐狸'" in errors
    save = tmp_path / "toybox/t/save"
    names = {path.name for path in save.glob("it2-export/*")}
    assert {"gaussians.ply", "gaussians.spz", "points.ply", "view.html"} <= names
    assert (save / "prior/points.npz").is_file()
    arguments = ["--metrics", "judge,janus,clip,directions", "--output", str(tmp_path / "scores")]
    arguments += ["--judge", str(exported), "--clip", str(exported)]
    assert evaluate([str(tmp_path / "toybox"), *arguments]) == 0
    with open(tmp_path / "scores" / "scorecard.csv", newline="") as file:
        (row,) = csv.DictReader(file)
    assert row["kind"] in ("0.0", "1.0") and 0 <= float(row["multi_face"]) <= 1
    content = json.loads((tmp_path / "scores" / "scorecard.json").read_text())
    assert -100 <= content["clip"]["mean"]["mean"] <= 100


def test_a_long_text_is_a_prompt(exported, tmp_path, capsys):
    quick = ("trainer.max_steps=1", "system.pages=false")
    assert run(exported, tmp_path, "a red fox " * 400, *quick) == 0  # of known words
    assert "wasn't trained on" not in (errors := capsys.readouterr().err)
    assert "the text encoder takes 32: what comes last has no effect" in errors


def test_what_the_models_can_not_do_is_named_before_any_work(exported, tmp_path, capsys):
    for prompt, option, message in (
        ("", "seed=0", "no prompt: give one"),
        (PROMPT, "system.guidance.image_size=100", "a multiple of 8"),
        (PROMPT, f"{MODEL}=toy-box", "did you mean the bundled 'toybox'?"),
    ):
        assert run(exported, tmp_path, prompt, option) == 2
        assert message in capsys.readouterr().err
        assert not (tmp_path / "toybox").exists()
