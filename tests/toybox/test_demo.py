"""The demo of text to 3D: runs, sheet, table, and going on after an interruption."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from PIL import Image

from tests.toybox.helpers import copied
from tests.toybox.test_text_to_3d import PROMPT, QUICK
from threestudio_gaussiandreamer.launch.experiment import main as launcher
from threestudio_gaussiandreamer.models.bundled import JUDGE, write_digests
from threestudio_gaussiandreamer.toybox import demo, models
from threestudio_gaussiandreamer.toybox.export import write_weights
from threestudio_gaussiandreamer.toybox.words import attributes_in
from threestudio_gaussiandreamer.toybox.world import withheld
from threestudio_gaussiandreamer.view.run_files import read_json

OPTIONS = [option for option in QUICK if "=t" not in option[-3:] and "timestamp" not in option]
OPTIONS += ["system.pages=false", "system.exporter={formats: [ply], save_video: false}"]

FULL_SIZE = models.Judge.CHANNELS
"""Of the judge, before a fixture makes it smaller."""


@pytest.fixture
def in_process(monkeypatch, small_world):
    """Run the launcher in this process, and note how often; draw samples in few steps."""
    runs = []
    monkeypatch.setattr(demo, "SAMPLE_STEPS", 2)

    def launch(options):
        runs.append(options)
        if code := launcher(["--config", "toybox.yaml", "--train", "--gpu", "cpu", *options]):
            raise SystemExit(code)

    monkeypatch.setattr(demo, "launch", launch)
    return runs


def arguments(exported, folder, *prompts):
    return [*prompts, "--models", str(exported), "--output", str(folder), *OPTIONS]


def test_one_of_the_default_prompts_is_withheld_from_training():
    assert [withheld(attributes_in(prompt)) for prompt in demo.PROMPTS] == [False, False, True]


def test_an_interrupted_demo_continues_and_ends_with_a_sheet_and_a_table(
    exported, tmp_path, monkeypatch, capsys, in_process
):
    words, launch = arguments(exported, tmp_path, PROMPT, "a zebra: 1=2"), demo.launch

    def stopped(options):
        launch(options)
        monkeypatch.setattr(demo, "launch", interrupted)

    def interrupted(options):
        time.sleep(0.5)
        raise KeyboardInterrupt

    monkeypatch.setattr(demo, "launch", stopped)
    assert demo.main(words) == 130
    monkeypatch.setattr(demo, "launch", launch)
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


def test_an_error_of_a_run_ends_the_demo(exported, tmp_path, in_process):
    with pytest.raises(SystemExit) as end:
        demo.main([*arguments(exported, tmp_path, PROMPT), "trainer.max_stepz=2"])
    assert end.value.code == 2


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ([""], "a prompt is empty"),
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


@pytest.mark.slow
def test_ctrl_c_writes_a_checkpoint_and_tells_how_to_continue(exported, tmp_path, monkeypatch):
    # the other process builds a judge of full size; the other networks' sizes are in their files
    monkeypatch.setattr(models.Judge, "CHANNELS", FULL_SIZE)
    folder = copied(exported, tmp_path / "models")
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
