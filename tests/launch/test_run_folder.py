"""The folder of a run that is resumed: its own, also if it was moved, copied or renamed."""

import json
import shutil
from datetime import datetime
from pathlib import Path

import pytest
from omegaconf import OmegaConf

from tests.launch.cases import load
from threestudio_gaussiandreamer.core.checkpoint_file import save_file
from threestudio_gaussiandreamer.launch import run_folder
from threestudio_gaussiandreamer.launch.config import dump_config, load_config

CHECKPOINT = {"state_dict": {}, "epoch": 0, "global_step": 3}


def test_paths_of_one_file_are_no_change(folder):
    assert run_folder._is_same("my.glb", "./my.glb") and run_folder._is_same(3, 3)
    assert run_folder._is_same("my.glb", str(Path("my.glb").absolute()))
    assert not run_folder._is_same("my.glb", "other.glb") and not run_folder._is_same(3, "3")


@pytest.fixture
def copied(folder):
    """A run's folder, copied and renamed; both have a checkpoint."""
    run = Path(load("tag=a", "use_timestamp=false").trial_dir)
    save_file(run / "ckpts/last.ckpt", CHECKPOINT)
    (run / "configs").mkdir()
    dump_config(run / "configs/parsed.yaml", load("tag=a", "use_timestamp=false"))
    return shutil.copytree(run, folder / "outputs/tiny/b")


@pytest.mark.parametrize("resume", ["auto", "outputs/tiny/b/ckpts/last.ckpt"])
def test_a_copy_of_a_run_continues_in_its_own_folder(folder, copied, resume):
    parsed = "outputs/tiny/b/configs/parsed.yaml"
    for _ in range(2):
        cfg = load_config(parsed, cli_args=[f"resume={resume}"])
        assert cfg.trial_dir == str(copied) and cfg.trial_name == "b" and not cfg.new_folder
        assert Path(cfg.resume).resolve() == copied / "ckpts/last.ckpt"
        dump_config(parsed, cfg)  # as the run does, which is resumed once more


def test_of_another_part_only_its_type_is_named(folder):
    system = {"background_type": "sky", "background": {"mode": "random"}}
    (folder / "a/configs").mkdir(parents=True)
    (folder / "a/configs/parsed.yaml").write_text(json.dumps({"system": system}))
    cfg = OmegaConf.create({"resume": str(folder / "a/ckpts/last.ckpt"), "system": {}})
    kind = "system.background_type was 'sky', now it is 'gaussiandreamer-background'"
    assert run_folder.changes_since(cfg, run_folder.SIZES) == [kind]
    cfg.system = {"background_type": "sky", "background": {"mode": "fixed"}}
    mode = "system.background.mode was 'random', now it is 'fixed'"
    assert run_folder.changes_since(cfg, run_folder.SIZES) == [mode]


@pytest.mark.parametrize(
    "options",
    [["resume=outputs/tiny/a/ckpts/last.ckpt"], ["resume=auto", "tag=c"], []],
    ids=["another run's checkpoint", "another tag", "not resumed"],
)
def test_a_copy_of_a_run_is_left_for_other_folders(folder, copied, options):
    cfg = load_config("outputs/tiny/b/configs/parsed.yaml", cli_args=options)
    assert cfg.trial_dir == f"outputs/tiny/{'c' if 'tag=c' in options else 'a'}"


def test_a_run_of_the_same_name_elsewhere_is_left_with_a_warning(folder, caplog):
    cfg = load("tag=a", "use_timestamp=false", "resume=other/outputs/tiny/a/ckpts/last.ckpt")
    here, other = folder / "outputs/tiny/a", folder / "other/outputs/tiny/a"
    said = f"the checkpoint is of the run in {other}; this one writes to {here}"
    assert Path(cfg.trial_dir).absolute() == here and said in caplog.text


def test_a_run_of_the_same_second_is_resumed_in_its_folder(folder, monkeypatch):
    class Noon(datetime):
        @classmethod
        def now(cls, tz=None):
            return cls(2026, 1, 1, 12)

    monkeypatch.setattr(run_folder, "datetime", Noon)
    first = load("tag=a")
    save_file(Path(first.trial_dir, "ckpts/last.ckpt"), CHECKPOINT)
    again = load("tag=a", "resume=auto")
    assert first.new_folder and not again.new_folder and again.trial_dir == first.trial_dir
