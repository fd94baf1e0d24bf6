"""The launcher from arguments to results, with a system of a few parameters: stages, mistakes."""

import os
import shutil
from pathlib import Path

import imageio.v3 as iio
import pytest

from tests.helpers import tiny_parts
from tests.helpers.gallery import files, only_run
from threestudio_gaussiandreamer.core.checkpoint_file import load_file
from threestudio_gaussiandreamer.launch.config import load_config


def evaluate(launch, trained, stage: str, *options: str) -> set[str]:
    before = files(trained)
    resume = f"resume={trained}/ckpts/last.ckpt"
    code, _, _ = launch(stage, resume, *options, config=f"{trained}/configs/parsed.yaml")
    assert code == 0 and only_run() == trained
    return files(trained) - before


def test_validation_test_and_export_of_a_checkpoint_write_under_its_step(launch, trained):
    for name in ("it6-0.png", "it6-test.mp4"):
        (trained / "save" / name).unlink()
    assert evaluate(launch, trained, "--validate") == {"save/it6-0.png"}
    assert evaluate(launch, trained, "--test") == {"save/it6-test.mp4"}
    assert evaluate(launch, trained, "--export") == {"save/it6-export/means.npz"}
    # the cloud of the checkpoint, not the one that training starts from
    means = load_file(trained / "ckpts/last.ckpt")["state_dict"]["geometry.means"]
    pixel = iio.imread(trained / "save/it6-0.png")[0, 0]
    assert pixel.tolist() == (means.sigmoid() * 255).round().int().tolist()
    shutil.rmtree(trained / "save")
    video = evaluate(launch, trained, "--export", "system.exporter.save_video=true")
    assert video >= {"save/it6-export/means.npz", "save/it6-test.mp4"}
    # into a new folder, with a record
    code, _, _ = launch("--export", f"resume={trained}/ckpts/last.ckpt", "tag=other")
    (other,) = Path("outputs").glob("*/other*")
    assert code == 0 and other != trained
    assert load_config(other / "configs/parsed.yaml").tag == "other"
    assert "--export" in (other / "cmd.txt").read_text() and not (other / "code").exists()


def test_the_record_is_there_before_the_cloud(launch, monkeypatch):
    """A run that is stopped in its prior can be looked at, and started again."""
    found = []

    def prior(system):
        found.extend(files(only_run()))
        raise KeyboardInterrupt

    monkeypatch.setattr(tiny_parts.TinySystem, "configure_optimizers", prior)
    assert launch("--train")[0] == 130
    assert {"configs/parsed.yaml", "cmd.txt"} <= set(found)


def test_evaluating_without_a_checkpoint_gives_a_message(launch):
    code, _, err = launch("--test")
    assert code == 0 and "no checkpoint given" in err
    assert (only_run() / "save/it0-test.mp4").is_file()


def test_parts_are_told_every_step(launch, monkeypatch):
    systems, original = [], tiny_parts.TinySystem.configure
    configure = lambda self: (original(self), systems.append(self))[0]  # noqa: E731
    monkeypatch.setattr(tiny_parts.TinySystem, "configure", configure)
    assert launch("--train", "trainer.limit_val_batches=0")[0] == 0
    # six training batches, then two test views at the last step
    assert systems[0].geometry.updates == [0, 1, 2, 3, 4, 5, 6, 6]


@pytest.mark.parametrize("place", ["configure", "on_fit_start", "step 0"])
def test_a_mistake_is_one_message_and_leaves_nothing(launch, place):
    code, out, err = launch("--train", f"system.fail_in={place}")
    assert code == 2 and out == "" and f"failed in {place}, as asked" in err
    assert "Traceback" not in err
    assert os.listdir() == ["tiny.yaml"]


def test_a_mistake_has_a_traceback_if_that_is_asked_for(launch):
    Path("outputs/other").mkdir(parents=True)
    code, _, err = launch("--train", "--verbose", "system.fail_in=on_fit_start")
    assert code == 2 and "failed in on_fit_start, as asked" in err and "Traceback" in err
    assert os.listdir("outputs") == ["other"]


def test_a_mistake_after_the_first_step_keeps_what_was_done(launch):
    code, _, err = launch("--train", "system.fail_in=step 3", "checkpoint.every_n_train_steps=2")
    assert code == 2 and "failed in step 3" in err
    assert "ckpts/last.ckpt" in files(only_run())
