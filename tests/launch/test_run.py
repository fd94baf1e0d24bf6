"""What a run writes beside its results, and concurrent runs in one folder."""

import datetime
import errno
import fcntl
import os
import shutil
import signal
import sys
from pathlib import Path

import pytest

from tests.helpers import tiny_parts
from tests.helpers.tiny_runs import files, only_run
from threestudio_gaussiandreamer.core.checkpoint_file import load_checkpoint
from threestudio_gaussiandreamer.core.errors import UserError
from threestudio_gaussiandreamer.launch import (
    callbacks,
    checkpoints,
    experiment,
    run,
    run_folder,
)
from threestudio_gaussiandreamer.launch.config import load_config
from threestudio_gaussiandreamer.launch.ddp import ReplicatedStrategy
from threestudio_gaussiandreamer.launch.experiment import main
from threestudio_gaussiandreamer.launch.folder_lock import claim
from threestudio_gaussiandreamer.view.run_index import write_index

# -- files beside the run --------------------------------------------------------------------------


def test_what_is_no_source_in_custom_is_neither_loaded_nor_copied(launch):
    Path("custom/package").mkdir(parents=True)
    Path("custom/part.py").write_text("LOADED = True")
    Path("custom/package/__init__.py").write_text("from . import inner")
    Path("custom/package/inner.py").write_text("")
    for lock in ("custom/.#part.py", "custom/package/.#inner.py", "custom/gone.py"):
        os.symlink("someone@somewhere.1234", lock)  # as Emacs makes while a file is edited
    os.mkfifo("custom/pipe.py")
    os.mkfifo("custom/package/pipe.yaml")
    code, _, err = launch("--train", "trainer.limit_val_batches=0")
    assert code == 0 and "custom/pipe.py is no readable file" in err
    copied = {name for name in files(only_run() / "code/custom") if not name.endswith(".pyc")}
    assert copied == {"part.py", "package/__init__.py", "package/inner.py"}


def test_a_source_that_can_not_be_read_is_left_out_of_the_copy_with_a_warning(
    launch, monkeypatch, tmp_path
):
    def forbidden(path):
        if path.name == "secret.py":
            raise PermissionError(13, "Permission denied")
        return read_bytes(path)

    read_bytes = Path.read_bytes
    (tmp_path / "source").mkdir()
    (tmp_path / "source/secret.py").touch()
    (tmp_path / "source/part.py").touch()
    monkeypatch.setattr(Path, "read_bytes", forbidden)
    read = dict(callbacks.read_sources(tmp_path / "source", tmp_path / "copy"))
    assert read == {tmp_path / "copy/part.py": b""}


def test_data_beside_a_part_is_recorded_up_to_a_total_size(tmp_path, caplog):
    def read(data_bytes):
        found = callbacks.read_sources(tmp_path / "part", tmp_path, data_bytes)
        return {path.name for path, _ in found}

    (tmp_path / "part").mkdir()
    for name in ("part.py", "sizes.json", ".hidden"):
        (tmp_path / "part" / name).write_text("1")
    (tmp_path / "part/weights.npy").write_bytes(bytes(11))
    assert read(10) == {"part.py", "sizes.json"}
    assert "1 files below" in caplog.text and "weights.npy, aren't copied" in caplog.text
    caplog.clear()
    read(1)  # nothing is left then
    assert "1 files below" in caplog.text
    assert read(12) == {"part.py", "sizes.json", "weights.npy"}


def test_a_deleted_configuration_is_stored_as_it_was_read(launch, monkeypatch):
    monkeypatch.setattr(
        tiny_parts.TinySystem, "post_configure", lambda self: os.unlink("tiny.yaml")
    )
    assert launch("--train")[0] == 0
    assert Path(only_run(), "configs/raw.yaml").read_text() == tiny_parts.CONFIG


def test_the_record_of_the_command_holds_names_that_are_no_utf8(launch):
    name = os.fsdecode(b"caf\xe9.yaml")
    Path(name).write_text(tiny_parts.CONFIG)
    assert launch("--train", config=name)[0] == 0
    assert b"--config 'caf\xe9.yaml' --train" in (only_run() / "cmd.txt").read_bytes()


def test_a_fifo_in_the_place_of_a_copy_is_replaced(launch):
    """Writing to it would wait for a reader."""
    copy = Path("outputs/tiny/t/configs/raw.yaml")
    copy.parent.mkdir(parents=True)
    os.mkfifo(copy)
    assert launch("--train", "use_timestamp=false", "tag=t")[0] == 0
    assert copy.read_text() == tiny_parts.CONFIG


def test_a_configuration_that_can_not_be_read_is_named(launch, monkeypatch):
    def vanished(path):
        raise FileNotFoundError(2, "No such file or directory", str(path))

    monkeypatch.setattr(Path, "read_bytes", vanished)
    code, _, err = launch("--train")
    assert code == 2 and "error: the configuration tiny.yaml can't be read" in err


class Built(Exception):
    """Raised with the options of the trainer, in place of building it."""


@pytest.fixture
def stop_before_trainer(monkeypatch):
    def build(section, owner, options):
        raise Built(options)

    monkeypatch.setattr(run, "build", build)


@pytest.mark.parametrize("strategy", [None, "auto", "ddp"])
def test_several_gpus_train_replicas_of_one_cloud(
    launch, monkeypatch, stop_before_trainer, strategy
):
    """Also if the configuration states the default explicitly: DDP's wrapper would keep the
    parameters that densification replaces.
    """
    monkeypatch.setattr(experiment, "announce_device", lambda gpu: 2)
    with pytest.raises(Built) as built:
        launch("--train", *([f"trainer.strategy={strategy}"] if strategy else []))
    options = built.value.args[0]
    assert isinstance(options["strategy"], ReplicatedStrategy) and options["devices"] == 2


def test_nothing_is_profiled_unless_it_is_asked_for(launch, stop_before_trainer):
    for overrides, profiler in ([], callbacks.NoProfiler), (["trainer.profiler=simple"], str):
        with pytest.raises(Built) as built:
            launch("--train", *overrides)
        assert type(built.value.args[0]["profiler"]) is profiler
    with callbacks.NoProfiler().profile("a hook"):
        pass


# -- runs that meet --------------------------------------------------------------------------------

ONE_FOLDER = ["use_timestamp=false", "tag=run"]


def test_a_run_from_step_0_puts_earlier_checkpoints_aside(launch):
    """Else resume=auto may take a later step of the earlier run."""
    for steps in (4, 2):
        assert launch("--train", *ONE_FOLDER, f"trainer.max_steps={steps}")[0] == 0
    folder = Path("outputs/tiny/run")
    kept = [load_checkpoint(folder / name / "last.ckpt") for name in ("ckpts-2", "ckpts")]
    assert [content["global_step"] for content in kept] == [4, 2]
    _, out, err = launch("--train", *ONE_FOLDER, "trainer.max_steps=3", "seed=5", "resume=auto")
    assert "(step 2)" in out + err and "of another run: seed was 3, now it is 5" in out + err


def test_a_run_from_step_0_puts_earlier_results_aside(launch):
    """Else the page of the run may show a later step of the earlier run; its prior serves again."""
    save = Path("outputs/tiny/run/save")
    for name in ("it9-export", "prior"):
        (save / name).mkdir(parents=True)
        (save / name / "file").write_text(name)
    assert launch("--train", *ONE_FOLDER)[0] == 0
    aside = save.with_name("save-2")
    assert {path.name for path in aside.iterdir()} == {"it9-export", "prior"}
    assert (save / "prior/file").read_text() == "prior" and not (save / "it9-export").exists()
    assert launch("--train", *ONE_FOLDER, "resume=auto", "trainer.max_steps=9")[0] == 0
    assert not save.with_name("save-3").exists()


def fail_in(stage, monkeypatch):
    def fail(*_: object) -> None:
        raise UserError("none.glb does not exist")

    monkeypatch.setattr(tiny_parts.TinySystem, stage, fail)


@pytest.mark.parametrize("stage", ["configure_optimizers", "training_step"])
@pytest.mark.parametrize("options", [["seed=5"], ["resume=auto", "seed=5", "trainer.max_steps=9"]])
def test_a_start_that_fails_leaves_the_earlier_run_in_its_place(
    launch, monkeypatch, stage, options
):
    """The prior runs in ``configure_optimizers``; ``training_step`` is before a checkpoint."""
    Path("custom").mkdir()
    Path("custom/part.py").write_text("OF = 'the first run'")
    assert launch("--train", *ONE_FOLDER)[0] == 0
    folder = Path("outputs/tiny/run")
    names = {name for name in files(folder) if name.startswith(("configs/", "code/", "ckpts/"))}
    names.add("cmd.txt")
    record = {name: (folder / name).read_bytes() for name in names}
    Path("custom/part.py").write_text("OF = 'the second'")
    with monkeypatch.context() as patch:
        fail_in(stage, patch)
        code, out, err = launch("--train", *ONE_FOLDER, *options)
    assert code and "none.glb does not exist" in out + err
    assert "to resume" not in out or "resume=auto" in options
    assert {name: (folder / name).read_bytes() for name in names} == record
    assert not (folder / "ckpts-2").exists()
    again = ["resume=auto", "trainer.max_steps=8"]
    assert launch("--train", *again, config=str(folder / "configs/parsed.yaml"))[0] == 0
    assert load_checkpoint(folder / "ckpts/last.ckpt")["global_step"] == 8
    assert load_config(folder / "configs/parsed.yaml").seed == 3


def test_an_option_that_does_not_fit_the_checkpoint_leaves_the_record_of_the_run(launch):
    assert launch("--train", *ONE_FOLDER)[0] == 0
    parsed = Path("outputs/tiny/run/configs/parsed.yaml")
    record = parsed.read_bytes()
    resumed = ["resume=auto", "trainer.max_steps=8"]
    code, _, err = launch("--train", *ONE_FOLDER, *resumed, "system.geometry.size=4")
    assert code == 2 and "was made by another configuration" in err
    assert parsed.read_bytes() == record
    assert launch("--train", *resumed, config=str(parsed))[0] == 0


def test_the_record_of_a_new_run_is_written_with_its_first_checkpoint(launch, monkeypatch):
    """At each write there is either no checkpoint beside the record, or one of the same run."""
    assert launch("--train", *ONE_FOLDER)[0] == 0
    folder = Path("outputs/tiny/run")
    parsed, last, seen = folder / "configs/parsed.yaml", folder / "ckpts/last.ckpt", []

    def save(path, content):
        seen.append((load_config(parsed).seed, last.is_file()))
        save_file(path, content)

    save_file = checkpoints.save_file
    monkeypatch.setattr(checkpoints, "save_file", save)
    assert launch("--train", *ONE_FOLDER, "seed=5")[0] == 0
    assert seen[0] == (5, False)
    seen.clear()
    go_on = ["resume=auto", "trainer.max_steps=9"]
    assert launch("--train", *ONE_FOLDER, *go_on, "seed=7")[0] == 0
    assert seen[0] == (5, True) and load_config(parsed).seed == 7


def test_a_full_disk_leaves_the_results_that_would_be_set_aside(launch, monkeypatch):
    save = Path("outputs/tiny/run/save")
    for name in ("it9-export", "prior"):
        (save / name).mkdir(parents=True)
        (save / name / "file").write_text(name)

    def copy(source, target, **_):
        Path(target).write_text("ha")  # half of it
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), target)

    with monkeypatch.context() as patch:
        patch.setattr(shutil, "copyfile", copy)
        code, _, err = launch("--train", *ONE_FOLDER)
    assert code == 2 and "No space left on device" in err and "make room" in err
    assert files(save.parent) >= {"save/it9-export/file", "save/prior/file"}
    assert not list(save.parent.glob("save-*")) and (save / "prior/file").read_text() == "prior"
    assert launch("--train", *ONE_FOLDER)[0] == 0 and save.with_name("save-2").is_dir()


def test_a_run_may_start_from_the_weights_of_the_checkpoints_that_it_puts_aside(launch):
    assert launch("--train", *ONE_FOLDER)[0] == 0
    weights = "system.weights=outputs/tiny/run/ckpts/last.ckpt"
    code, _, err = launch("--train", *ONE_FOLDER, weights)
    assert code == 0, err
    assert Path("outputs/tiny/run/ckpts-2/last.ckpt").is_file()


def test_a_run_that_is_refused_leaves_the_folder_of_the_one_that_trains(launch, monkeypatch):
    """The rejected run creates the folder and is stopped before it locks it; it continues while the
    other one trains.
    """
    with monkeypatch.context() as patch:
        flock = fcntl.flock
        patch.setattr(
            fcntl, "flock", lambda *lock: (os.kill(os.getpid(), signal.SIGSTOP), flock(*lock))[1]
        )
        refused = os.fork()
        if refused == 0:
            os._exit(main(["--config", "tiny.yaml", "--train", *ONE_FOLDER]))
        assert os.WIFSTOPPED(os.waitpid(refused, os.WUNTRACED)[1])
    ended = []

    def let_it_go_on(system, batch, batch_idx):
        if system.global_step == 1:  # when nothing is saved yet
            os.kill(refused, signal.SIGCONT)
            ended.append(os.waitstatus_to_exitcode(os.waitpid(refused, 0)[1]))
        return training_step(system, batch, batch_idx)

    training_step = tiny_parts.TinySystem.training_step
    monkeypatch.setattr(tiny_parts.TinySystem, "training_step", let_it_go_on)
    assert launch("--train", *ONE_FOLDER)[0] == 0 and ended == [2]
    assert {"cmd.txt", "save/it3-0.png", "ckpts/last.ckpt"} <= files(Path("outputs/tiny/run"))


def test_a_folder_in_use_is_refused_before_the_parts_are_built(launch, monkeypatch):
    first = claim(Path("outputs/tiny/run"))
    monkeypatch.setattr(tiny_parts.TinySystem, "configure", lambda self: 1 / 0)
    code, _, err = launch("--train", *ONE_FOLDER)
    first.release()
    assert code == 2 and "another run is training in outputs/tiny/run" in err


def test_runs_of_one_second_have_a_folder_each(launch, monkeypatch):
    class Noon(datetime.datetime):
        @classmethod
        def now(cls):
            return cls(2026, 1, 31, 12, 0, 0)

    monkeypatch.setattr(run_folder, "datetime", Noon)
    for _ in range(3):
        assert launch("--train", "trainer.max_steps=1", "trainer.limit_val_batches=0")[0] == 0
    folders = sorted(Path("outputs/tiny").iterdir())
    name = "a_red_ball@20260131-120000"
    assert [folder.name for folder in folders] == [name, f"{name}-2", f"{name}-3"]
    assert load_config(folders[1] / "configs/parsed.yaml").trial_dir == str(folders[1])


def test_a_file_that_another_stage_removes_is_named_in_one_line(launch, trained, monkeypatch):
    """As the pictures of a turntable, which another --test of the same step writes too."""
    test_step = tiny_parts.TinySystem.test_step

    def removed_after(system, batch, batch_idx):
        test_step(system, batch, batch_idx)
        Path(system.get_save_path(f"it6-test/{int(batch['index'])}.png")).unlink()
        open(system.get_save_path("it6-test/0.png"), "rb")

    monkeypatch.setattr(tiny_parts.TinySystem, "test_step", removed_after)
    code, _, err = launch(
        "--test", f"resume={trained}/ckpts/last.ckpt", config=f"{trained}/configs/parsed.yaml"
    )
    assert code == 2 and "another command works in" in err and "it6-test/0.png" in err


def test_a_second_test_in_a_folder_is_refused_and_a_training_is_not(launch, trained):
    options = ("--test", f"resume={trained}/ckpts/last.ckpt")
    config = f"{trained}/configs/parsed.yaml"
    training, other = claim(trained), claim(trained / ".test")
    code, _, err = launch(*options, config=config)
    assert code == 2 and f"another --test is at work in {trained}/.test" in err
    other.discard()
    assert launch(*options, config=config)[0] == 0 and not (trained / ".test").exists()
    training.release()


def test_an_index_lists_what_is_left(trained, monkeypatch):
    class Vanishing(type(Path())):
        def stat(self, **options):
            if self.name == "it3-0.png" and sys._getframe(1).f_code.co_name == "_size":
                raise FileNotFoundError(2, "No such file or directory", str(self))
            return super().stat(**options)

    assert "it6-0.png" in write_index(Vanishing(trained)).read_text()
