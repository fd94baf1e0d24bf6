"""From a prompt to a measured cloud with learned models, tiny ones here: configs/toybox.yaml, the
scorecard of its runs, wrong input; and the demo: sheet, table, going on after an interruption.
"""

import csv
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import yaml
from PIL import Image

from tests.training.runs import CONFIGS
from threestudio_gaussiandreamer.evaluation.scorecard import main as evaluate
from threestudio_gaussiandreamer.launch.experiment import main as launch
from threestudio_gaussiandreamer.models.bundled import JUDGE, write_digests
from threestudio_gaussiandreamer.priors import motion
from threestudio_gaussiandreamer.toybox import demo, models, motions, views
from threestudio_gaussiandreamer.toybox.export import write_weights
from threestudio_gaussiandreamer.view.run_files import read_json

PROMPT = "a red fox with a green scarf"
QUICK = [
    "trainer.max_steps=2", "trainer.enable_progress_bar=false", "system.geometry.prior.num_steps=2",
    "system.geometry.prior.num_points=40", "data.n_test_views=1", "data.eval_width=32",
    "data.eval_height=32", "use_timestamp=false", "tag=t",
]  # fmt: skip

OPTIONS = [option for option in QUICK if "=t" not in option[-3:] and "timestamp" not in option]
OPTIONS += ["system.pages=false", "system.exporter={formats: [ply], save_video: false}"]
"""Of the demo."""
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
    """With unknown words and a cut end, which are named, and with the models of one folder."""
    assert run(exported, tmp_path, f"a red fox with a skarf 狐狸 🦊 {'a red fox ' * 400}") == 0
    assert "wasn't trained on" in (errors := capsys.readouterr().err)
    assert "'skarf' (near: scarf)" in errors and "'狐狸'" in errors
    assert "the text encoder takes 32: what comes last has no effect" in errors
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


def test_what_the_models_can_not_do_is_named_before_any_work(exported, tmp_path, capsys):
    for option, message in (
        ("system.guidance.image_size=100", "a multiple of 8"),
        (f"{MODEL}=toy-box", "did you mean the bundled 'toybox'?"),
    ):
        assert run(exported, tmp_path, PROMPT, option) == 2
        assert message in capsys.readouterr().err
        assert not (tmp_path / "toybox").exists()


# The demo -----------------------------------------------------------------------------------------

FULL_SIZE = models.Classifier.CHANNELS
"""Of the judge, before a fixture makes it smaller."""


@pytest.fixture
def in_process(monkeypatch):
    """Run the launcher in this process, and note how often; draw samples in few steps."""
    runs = []
    monkeypatch.setattr(demo, "SAMPLE_STEPS", 2)

    def launched(config, options):
        runs.append(config)
        return launch(["--config", config, "--train", "--gpu", "cpu", *options])

    monkeypatch.setattr(demo, "launch", launched)
    return runs


def arguments(exported, folder, *prompts):
    return [*prompts, "--models", str(exported), "--output", str(folder), *OPTIONS]


def test_an_interrupted_demo_continues_and_ends_with_a_sheet_and_a_table(
    exported, tmp_path, monkeypatch, capsys, in_process
):
    words, launched = arguments(exported, tmp_path, PROMPT, "a zebra: 1=2"), demo.launch

    def stopped(*arguments):
        monkeypatch.setattr(demo, "launch", interrupted)
        return launched(*arguments)

    def interrupted(*arguments):
        time.sleep(0.5)
        raise KeyboardInterrupt

    monkeypatch.setattr(demo, "launch", stopped)
    assert demo.main(words) == 130
    monkeypatch.setattr(demo, "launch", launched)
    assert demo.main(words) == 0
    (folder,) = tmp_path.iterdir()
    assert len(in_process) == 2 and str(folder / "sheet.png") in capsys.readouterr().out
    record = read_json(folder / "runs" / "prompt2_a_zebra_1_2.json", dict)
    assert record["finished"] and record["seconds"] >= 0.5  # with those before the interruption
    lines = (folder / "table.md").read_text().splitlines()
    assert len(lines) == 2 + 2 * 3 and PROMPT in lines[2] and lines[3].split("|")[-2].strip()
    assert lines[6].split("|")[3:8] == ["  "] * 5  # no known kind: nothing is recognised
    assert Image.open(folder / "sheet.png").width == 9 * 128
    monkeypatch.setattr(demo, "launch", interrupted)
    assert demo.main(words) == 130 and len(list(tmp_path.iterdir())) == 2  # not the finished one


# Avatars ------------------------------------------------------------------------------------------

POSED = "a person in a red shirt and blue trousers stands in a T pose"


@pytest.fixture
def posing(exported, tmp_path, monkeypatch):
    """Models whose motions are all a T pose, roughly fitted; few frames are offered to CLIP."""
    folder = shutil.copytree(exported, tmp_path / "models")
    pose = motions.features(motions.draw("t pose", np.random.default_rng(0)).positions)
    np.save(folder / "motion/Mean.npy", pose[0])
    np.save(folder / "motion/Std.npy", np.full(len(pose[0]), 1e-6))
    write_digests(folder)
    for name, value in {"NUM_FRAMES": 1, "ROUGH": 5, "FINE": 40}.items():
        monkeypatch.setattr(motion, name, value)
    return folder


def test_the_demo_draws_an_avatar_which_goes_on_from_its_checkpoint(
    posing, tmp_path, in_process, monkeypatch
):
    """Pose and body are the first cells of its row; the pose's left is blue, on the right."""
    options = [option for option in OPTIONS if "prior" not in option]
    words = [POSED, "--models", str(posing), "--output", str(tmp_path / "out"), *options]
    assert demo.main(words) == 0 and in_process == [demo.AVATAR]
    (folder,) = (tmp_path / "out").iterdir()
    sheet = np.asarray(Image.open(folder / "sheet.png"))
    assert sheet.shape[1] == 9 * views.SIZE
    blue, red = (
        (sheet[: views.SIZE, : views.SIZE] == c).all(-1) for c in ((0, 0, 255), (255, 0, 0))
    )
    assert blue.any() and red.any() and blue.nonzero()[1].mean() > red.nonzero()[1].mean() + 20
    table = (folder / "table.md").read_text()
    assert "| action |" in table.splitlines()[0] and POSED in table
    place = next(folder.glob("runs/*/save")).parent
    saved = np.load(place / "save/prior/points.npz")
    assert saved["joints"].shape == (22, 3) and 1.3 < np.ptp(saved["points"][:, 2]) < 1.5
    middle = (saved["points"].max(0) + saved["points"].min(0)) / 2
    np.testing.assert_allclose(middle, 0, atol=1e-5)
    monkeypatch.setattr(motion.MotionPrior, "generate", None)  # the cloud is the checkpoint's
    more = ["--config", str(place / "configs/parsed.yaml"), "--train", "--gpu", "cpu"]
    more += [f"resume={place / 'ckpts/last.ckpt'}", "trainer.max_steps=3"]
    assert launch(more) == 0


@pytest.mark.parametrize(
    ("prompt", "config"),
    [
        ("a man in a green jacket and white pants bows", demo.AVATAR),
        ("Iron man kicks with his left leg", demo.AVATAR),
        ("someone opens the arms", demo.AVATAR),
        ("two persons walk", demo.AVATAR),  # which names what is wrong
        ("a person in a red shirt", demo.OBJECT),
        ("a red fox running with a green scarf", demo.OBJECT),
        ("a robot of a woman's size", demo.OBJECT),
    ],
)
def test_a_persons_motion_makes_an_avatar(prompt, config):
    assert demo.config_of(prompt) == config


def test_a_prompt_that_is_no_avatars_is_refused_before_any_work(posing, tmp_path, capsys):
    for prompt, message in (
        ("a person in a red shirt and blue trousers", "no action"),
        ("a person in a red shirt and blue trousers dances", "'dances'"),
        ("a man in a red shirt and a woman in a blue shirt bow", "more than one person"),
    ):
        words = [f"exp_root_dir={tmp_path}/out", f"system.prompt_processor.prompt={prompt}"]
        words += [f"{MODEL}={posing}", "--gpu", "cpu"]
        assert launch(["--config", "toybox-avatar.yaml", "--train", *words]) == 2
        assert message in capsys.readouterr().err and not (tmp_path / "out").exists()
        words = [PROMPT, prompt, "--models", str(posing), "--output", str(tmp_path / "demo")]
        if message != "no action":  # the demo's are then objects
            assert demo.main(words) == 2 and message in capsys.readouterr().err


@pytest.mark.slow
def test_clip_chooses_frames_that_show_the_action(tmp_path):
    """The bundled CLIP, of the bundled model's motions, which begin from rest."""
    heights = {"stands with open arms": 0.2, "raises both arms": 0.6, "stands in a T pose": 0.4}
    for action, height in heights.items():
        options = {**dict.fromkeys(("motion", "body_model", "clip"), "toybox"), "sample": 0}
        made = motion.MotionPrior(options)
        made(f"a person in a red shirt and blue trousers {action}")
        joints = made.joints
        assert joints[[20, 21], 1].min() > joints[0, 1] + height  # wrists above the pelvis


# Wrong input --------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ([PROMPT, "  "], "a prompt is empty"),
        (["a red \udcff"], "isn't valid UTF-8"),
        ([PROMPT, "--output", "{file}"], "--output"),
        ([PROMPT, "--models", "{file}"], "expected toybox, or a folder of toybox.export"),
    ],
)
def test_wrong_input_is_named(tmp_path, capsys, words, message):
    (tmp_path / "file").touch()
    assert demo.main([word.format(file=tmp_path / "file") for word in words]) == 2
    assert message in capsys.readouterr().err


def test_an_error_of_a_run_ends_the_demo(exported, tmp_path, in_process, capsys):
    assert demo.main([*arguments(exported, tmp_path, PROMPT), "trainer.max_stepz=2"]) == 2
    assert capsys.readouterr().err.count("error:") == 1


@pytest.mark.slow
def test_ctrl_c_writes_a_checkpoint_and_tells_how_to_continue(exported, tmp_path, monkeypatch):
    # the other process builds a judge of full size; the other networks' sizes are in their files
    monkeypatch.setattr(models.Classifier, "CHANNELS", FULL_SIZE)
    folder = shutil.copytree(exported, tmp_path / "models")
    write_weights(folder / JUDGE, models.Judge().state_dict())
    write_digests(folder)
    options = [*arguments(folder, tmp_path, PROMPT), "trainer.max_steps=500"]
    options += ["trainer.val_check_interval=2"]  # its first picture tells that training has begun
    command = [sys.executable, "-m", "threestudio_gaussiandreamer.toybox.demo", *options]
    root = Path(__file__).parents[2]
    first = subprocess.Popen(command, cwd=root, start_new_session=True, stdout=subprocess.PIPE)
    deadline = time.monotonic() + 300
    while not list(tmp_path.glob("*/runs/*/save/it*-0.png")):
        assert time.monotonic() < deadline and first.poll() is None
        time.sleep(0.2)
    os.killpg(first.pid, signal.SIGINT)
    output, _ = first.communicate(timeout=120)
    assert first.returncode == 130 and b"the same command continues" in output
    assert list(tmp_path.glob("*/runs/*/ckpts/last.ckpt"))
