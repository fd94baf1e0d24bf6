"""Every command exists, says what it takes, and does it."""

import json
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from threestudio_gaussiandreamer.formats.gaussian_files import read_cloud

from .commands import ROOT, command, launch, refused

COMMANDS = {
    "launch.experiment": "--config --train --validate --test --export --gpu --verbose --list-parts "
    "--version --typecheck",
    "convert": "--from --up --up-out --gaussians --spz-version --harmonics --antialiased --check "
    "--size --faces --texture --views --view-size --method --resolution --eps2d --unlit",
    "prune": "--count --bytes --psnr --within --quality --size --steps --eps2d --antialias --up",
    "evaluate": "--metrics --against --clip --imagereward --judge --size --output",
    "view": "--html --host --port --title --eps2d --preset --antialias --bound-colors --background "
    "--up",
    "farm": "--config --out --report --price --address --workers --gpus --cores --retries "
    "--time-limit",
    "toybox.demo": "--models --output PROMPT",
}
FORMATS = ["ply", "compressed.ply", "spz", "sog", "glb", "spz.glb", "usda"]


@pytest.mark.parametrize("module", COMMANDS)
def test_a_command_lists_its_options(module):
    result = command(module, "--help")
    words = result.out.replace(",", " ").replace("]", " ").split()
    options = COMMANDS[module].split()
    missing = [option for option in options if not any(option in word for word in words)]
    assert result.code == 0 and not missing


@pytest.mark.parametrize("module", COMMANDS)
def test_a_wrong_option_is_refused(module):
    result = command(module, "--no-such-option")
    assert result.code == 2 and "usage: " in result.err and "Traceback" not in result.err


def test_launch_py_is_the_launcher():
    script = [sys.executable, str(ROOT / "launch.py"), "--version"]
    done = subprocess.run(script, capture_output=True, text=True, check=True)
    assert done.stdout == launch("--version").out != ""


# -- the launcher ----------------------------------------------------------------------------------


def test_a_run_leaves_the_documented_files(trained):
    for name in (
        *("index.html", "ckpts/last.ckpt", "configs/raw.yaml", "configs/parsed.yaml", "cmd.txt"),
        *("times.json", "save/prior/points.npz", "save/it4-0.png", "save/it8-test.mp4"),
        *("save/it8-test/0.png", "save/it8-export/gaussians.ply", "save/it8-export/gaussians.spz"),
        *("save/it8-export/view.html", "csv_logs/version_0/metrics.csv"),
        "code/threestudio_gaussiandreamer/__init__.py",
    ):
        assert (trained / name).is_file(), name
    assert list(trained.glob("tb_logs/version_0/events*"))
    assert "--train" in (trained / "cmd.txt").read_text()
    assert not list(trained.rglob("*.tmp"))


@pytest.mark.parametrize(
    ("stage", "result"),
    [
        ("--validate", "it8-0.png"),
        ("--test", "it8-test.mp4"),
        ("--export", "it8-export/gaussians.ply"),
    ],
)
def test_a_stage_of_a_finished_run(earlier, stage, result):
    config = earlier / "configs/parsed.yaml"
    done = launch("--config", config, stage, "resume=auto")
    assert done.code == 0, done.err
    assert (earlier / "save" / result).is_file()


def test_a_stage_without_a_checkpoint_is_refused():
    for stage in ("validate", "test", "export"):
        result = launch("--config", "smoke.yaml", f"--{stage}", "resume=auto")
        refused(result, f"there is no checkpoint to --{stage}")


# -- the other commands ----------------------------------------------------------------------------


@pytest.mark.parametrize("suffix", FORMATS)
def test_convert_writes_and_reads_a_format(trained, suffix):
    source = trained / "save/it8-export/gaussians.ply"
    gaussians = ["--gaussians"] if suffix == "glb" else []
    result = command("convert", source, f"a.{suffix}", *gaussians)
    assert result.code == 0 and "250 Gaussians of degree 0" in result.out, result
    assert command("convert", f"a.{suffix}", "back.ply", "--check", "--size", "16").code == 0
    means = read_cloud("back.ply").in_axes("z").gaussians.means
    before = read_cloud(str(source)).in_axes("z").gaussians.means
    assert len(means) == 250 and abs(means.mean(0) - before.mean(0)).max() < 1e-3


def test_convert_takes_a_checkpoint(trained):
    assert command("convert", trained / "ckpts/last.ckpt", "a.ply").code == 0
    assert len(read_cloud("a.ply").gaussians.means) == 250


def test_prune_keeps_a_count(trained):
    source = trained / "save/it8-export/gaussians.spz"
    result = command("prune", source, "small.ply", "--count", "90", "--size", "32", "--steps", "2")
    assert result.code == 0, result.err
    assert len(read_cloud("small.ply").gaussians.means) == 90
    assert Path("small.ply.png").stat().st_size > 0
    with open("small.ply.json", encoding="utf-8") as report:
        assert json.load(report)["after"]["gaussians"] == 90


def test_view_writes_a_page_and_an_index(trained):
    source = trained / "save/it8-export/gaussians.ply"
    assert command("view", source, "--html", "page.html", "--title", "a ball").code == 0
    with open("page.html", encoding="utf-8") as page:
        text = page.read()
    assert "<title>a ball" in text and 'src="http' not in text
    shutil.copytree(trained / "configs", "runs/one/configs")
    assert command("view", "runs", "--html").code == 0 and Path("runs/index.html").is_file()


def test_evaluate_asks_for_its_model(trained):
    refused(command("evaluate", trained, "--metrics", "clip", "--output", "."), "--clip")
    refused(command("evaluate", trained, "--metrics", "nonsense"), "nonsense")


def test_the_demo_asks_for_its_models():
    refused(command("toybox.demo", "a red fox", "--models", "nothing"), "nothing")


def test_farm_checks_its_list_before_it_starts_a_cluster():
    Path("prompts.txt").write_text("a red ball\na blue ball\n")
    words = ["prompts.txt", "--config", "smoke.yaml", "--out", "farm"]
    refused(command("farm", *words, "--report"), "there is no farm in", "--out")
    refused(command("farm", *words, "trainer.max_stps=3"), "did you mean 'trainer.max_steps'")
    assert not Path("farm").exists()


@pytest.mark.slow
def test_the_demo_draws_a_prompt():
    pytest.importorskip("diffusers")
    words = ["a red fox", "--output", "out", "trainer.max_steps=2", "data.n_test_views=2"]
    result = command("toybox.demo", *words)
    assert result.code == 0, result.said
    assert list(Path("out").rglob("gaussians.ply")) and list(Path("out").glob("*/*.png"))
