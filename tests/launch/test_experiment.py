"""The launcher from arguments to results, with a system of a few parameters: stages, mistakes."""

import os
from pathlib import Path

import imageio.v3 as iio
import pytest
import torch

from tests.helpers import tiny_parts
from tests.helpers.tiny_runs import files, only_run
from threestudio_gaussiandreamer.core.checkpoint_file import load_file, save_file
from threestudio_gaussiandreamer.launch.config import load_config

# -- the stages ------------------------------------------------------------------------------------


def test_training_leaves_the_tree_of_threestudio(launch):
    code, out, _ = launch("--train")
    assert code == 0 and out == f"results are in {only_run()}/save\n"
    found = files(only_run())
    assert {
        "ckpts/epoch=0-step=6.ckpt",
        "ckpts/last.ckpt",
        "configs/raw.yaml",
        "configs/parsed.yaml",
        "cmd.txt",
        "code/threestudio_gaussiandreamer/launch/run.py",
        "csv_logs/version_0/metrics.csv",
        "save/it3-0.png",
        "save/it6-1.png",
        "save/it6-test/0.png",
        "save/it6-test.mp4",
    } <= found
    assert any(name.startswith("tb_logs/version_0/events") for name in found)
    assert Path(only_run(), "configs/raw.yaml").read_text() == tiny_parts.CONFIG
    assert load_config(only_run() / "configs/parsed.yaml").trial_dir == str(only_run())
    assert "--train" in Path(only_run(), "cmd.txt").read_text()
    assert not [name for name in found if name.endswith(".tmp")]


def evaluate(launch, trained, stage: str) -> set[str]:
    before = files(trained)
    code, _, _ = launch(
        stage, f"resume={trained}/ckpts/last.ckpt", config=f"{trained}/configs/parsed.yaml"
    )
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
    assert (
        iio.imread(trained / "save/it6-0.png")[0, 0].tolist()
        == (means.sigmoid() * 255).round().int().tolist()
    )


def test_an_export_into_a_new_folder_writes_a_record_too(launch, trained):
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


def test_export_with_video_renders_the_test_views(launch, trained):
    for path in (trained / "save").glob("it6-test*"):
        path.rename(trained / path.name)
    code, _, _ = launch(
        "--export",
        f"resume={trained}/ckpts/last.ckpt",
        "system.exporter.save_video=true",
        config=f"{trained}/configs/parsed.yaml",
    )
    assert code == 0 and {"save/it6-export/means.npz", "save/it6-test.mp4"} <= files(trained)


def test_evaluating_without_a_checkpoint_gives_a_message(launch):
    code, _, err = launch("--test")
    assert code == 0 and "no checkpoint given" in err
    assert (only_run() / "save/it0-test.mp4").is_file()


def test_parts_are_told_every_step(launch, monkeypatch):
    systems = []
    original = tiny_parts.TinySystem.configure
    monkeypatch.setattr(
        tiny_parts.TinySystem, "configure", lambda self: (original(self), systems.append(self))[0]
    )
    assert launch("--train", "trainer.limit_val_batches=0")[0] == 0
    # six training batches, then two test views at the last step
    assert systems[0].geometry.updates == [0, 1, 2, 3, 4, 5, 6, 6]


# -- mistakes --------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (
            ["--train", "system.geometry.sise=3"],
            "unknown key 'system.geometry.sise': did you mean 'system.geometry.size'?",
        ),
        (["--train", "system.fail_in=configure"], "failed in configure, as asked"),
        (["--train", "system.fail_in=on_fit_start"], "failed in on_fit_start, as asked"),
        (["--train", "system.fail_in=step 0"], "failed in step 0, as asked"),
        (["--train", "resume=nothing.ckpt"], "there is no checkpoint nothing.ckpt"),
        (["--train", "resume=tiny.yaml"], "tiny.yaml isn't a checkpoint"),
        (["--train", "resume=atuo"], "did you mean resume=auto, the newest one of this run?"),
        (["--train", "exp_root_dir=tiny.yaml/x"], "can't be written"),
        (["--train", "seed=-1"], "seed"),
        (["--train", "--gpu", "0"], "--gpu 0: torch"),
        (["--train", "--gpu", "one"], "--gpu one: expected cpu, or numbers"),
        (["--train", "trainer.max_steps"], "isn't an override"),
        (["--test", "resume=nothing.ckpt"], "there is no checkpoint nothing.ckpt"),
    ],
)
def test_a_mistake_is_one_message_and_leaves_nothing(launch, arguments, message):
    code, out, err = launch(*arguments)
    assert code == 2 and out == ""
    assert "Traceback" not in err and f"error: {message}" in err or message in err
    assert os.listdir() == ["tiny.yaml"]


def test_verbose_shows_the_traceback(launch):
    code, _, err = launch("--train", "--verbose", "system.fail_in=configure")
    assert code == 2 and "Traceback" in err and "failed in configure" in err


def test_a_mistake_after_the_first_step_keeps_what_was_done(launch):
    code, _, err = launch("--train", "system.fail_in=step 3", "checkpoint.every_n_train_steps=2")
    assert code == 2 and "failed in step 3" in err
    assert "ckpts/last.ckpt" in files(only_run())


def test_an_existing_folder_survives_a_mistake(launch):
    Path("outputs/other").mkdir(parents=True)
    assert launch("--train", "system.fail_in=on_fit_start")[0] == 2
    assert os.listdir("outputs") == ["other"]


@pytest.mark.parametrize("damage", ["other shape", "other optimiser", "truncated", "foreign"])
def test_a_checkpoint_that_does_not_fit_is_named(launch, trained, damage):
    path = trained / "ckpts/last.ckpt"
    checkpoint = load_file(path)
    arguments = [f"resume={path}"]
    if damage == "other shape":
        arguments.append("system.geometry.size=5")
    elif damage == "other optimiser":
        checkpoint["optimizer_states"][0]["param_groups"] *= 2
        save_file(path, checkpoint)
    elif damage == "truncated":
        path.write_bytes(path.read_bytes()[:-500])
    else:
        save_file(path, {"model": torch.ones(3)})
    code, _, err = launch("--train", "trainer.max_steps=8", *arguments)
    assert code == 2 and str(path) in err and "Traceback" not in err


def test_an_internal_error_keeps_its_traceback(launch, monkeypatch):
    monkeypatch.setattr(tiny_parts.TinySystem, "configure", lambda self: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        launch("--train")
