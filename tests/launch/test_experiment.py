"""The launcher from arguments to results, with a system of a few parameters: stages, folders,
mistakes, signals, resuming.
"""

import contextlib
import datetime
import fcntl
import os
import pty
import re
import shlex
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import imageio.v3 as iio
import pytest
import torch

import threestudio_gaussiandreamer
from tests.helpers import tiny_parts
from threestudio_gaussiandreamer.core.checkpoint_file import load_file, save_file
from threestudio_gaussiandreamer.core.errors import UserError
from threestudio_gaussiandreamer.launch import callbacks, checkpoints, experiment, run, run_folder
from threestudio_gaussiandreamer.launch.config import load_config
from threestudio_gaussiandreamer.launch.ddp import ReplicatedStrategy
from threestudio_gaussiandreamer.launch.experiment import main
from threestudio_gaussiandreamer.launch.folder_lock import claim

REPOSITORY = Path(__file__).resolve().parents[2]


@pytest.fixture
def launch(tmp_path, monkeypatch, capsys):
    """``launch("--train", overrides...)`` in an empty folder; returns (exit code, stdout,
    stderr).
    """
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(threestudio_gaussiandreamer, "register_parts", lambda: None)
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "")
    (tmp_path / "tiny.yaml").write_text(tiny_parts.CONFIG)

    def run(*arguments: str, config: str = "tiny.yaml") -> tuple[int, str, str]:
        code = main(["--config", config, *arguments])
        captured = capsys.readouterr()
        return code, captured.out, captured.err

    return run


def trial() -> Path:
    """The only trial's folder."""
    (folder,) = Path("outputs/tiny").iterdir()
    return folder


def files(folder: Path) -> set[str]:
    return {str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file()}


# -- the stages ------------------------------------------------------------------------------------


def test_training_leaves_the_tree_of_threestudio(launch):
    code, out, _ = launch("--train")
    assert code == 0 and out == f"results are in {trial()}/save\n"
    found = files(trial())
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
    assert Path(trial(), "configs/raw.yaml").read_text() == tiny_parts.CONFIG
    assert load_config(trial() / "configs/parsed.yaml").trial_dir == str(trial())
    assert "--train" in Path(trial(), "cmd.txt").read_text()
    assert not [name for name in found if name.endswith(".tmp")]


@pytest.fixture
def trained(launch):
    assert launch("--train")[0] == 0
    return trial()


def evaluate(launch, trained, stage: str) -> set[str]:
    before = files(trained)
    code, _, _ = launch(
        stage, f"resume={trained}/ckpts/last.ckpt", config=f"{trained}/configs/parsed.yaml"
    )
    assert code == 0 and trial() == trained
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


def test_evaluating_without_a_checkpoint_says_so(launch):
    code, _, err = launch("--test")
    assert code == 0 and "no checkpoint given" in err and (trial() / "save/it0-test.mp4").is_file()


def test_parts_are_told_every_step(launch, monkeypatch):
    systems = []
    original = tiny_parts.TinySystem.configure
    monkeypatch.setattr(
        tiny_parts.TinySystem, "configure", lambda self: (original(self), systems.append(self))[0]
    )
    assert launch("--train", "trainer.limit_val_batches=0")[0] == 0
    # six training batches, then two test views at the last step
    assert systems[0].geometry.updates == [0, 1, 2, 3, 4, 5, 6, 6]


def test_the_seed_decides(launch):
    results = []
    for seed in (3, 3, 4):
        assert launch("--train", f"seed={seed}", f"name=seed{len(results)}")[0] == 0
        (checkpoint,) = Path(f"outputs/seed{len(results)}").glob("*/ckpts/last.ckpt")
        results.append(load_file(checkpoint)["state_dict"]["geometry.means"])
    assert torch.equal(results[0], results[1]) and not torch.equal(results[0], results[2])


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
    assert "ckpts/last.ckpt" in files(trial())


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


def test_a_bug_keeps_its_traceback(launch, monkeypatch):
    monkeypatch.setattr(tiny_parts.TinySystem, "configure", lambda self: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        launch("--train")


# -- resuming --------------------------------------------------------------------------------------


def assert_same_training(a: Path, b: Path) -> None:
    """Bit for bit the same parameters and optimiser at the same step."""
    one, other = load_file(a), load_file(b)
    assert one["global_step"] == other["global_step"] and one["epoch"] == other["epoch"]
    assert all(
        torch.equal(one["state_dict"][key], other["state_dict"][key]) for key in one["state_dict"]
    )
    state, other_state = one["optimizer_states"][0]["state"], other["optimizer_states"][0]["state"]
    assert all(torch.equal(state[i][key], other_state[i][key]) for i in state for key in state[i])


@pytest.mark.parametrize(("name", "code"), [("SIGINT", 130), ("SIGTERM", 143), ("SIGHUP", 129)])
@pytest.mark.parametrize("step", [0, 2, 4, 5])
def test_stopped_and_resumed_equals_never_stopped(launch, name, code, step):
    # step 2 is followed by validation, step 5 is the last one
    assert launch("--train", "name=whole")[0] == 0
    stopped, out, err = launch("--train", f"system.signal_at={step}", f"system.signal_name={name}")
    assert stopped == code and "stopping after this step" in err or stopped == code
    assert f"stopped at step {step + 1}" in out and "it6-test" not in str(files(trial()))
    assert load_file(trial() / "ckpts/last.ckpt")["global_step"] == step + 1

    command = shlex.split(re.search("to go on: (.*)", out)[1])
    options = command[command.index("--config") :]
    assert options[1] == f"{trial()}/configs/parsed.yaml"
    assert main([*options, "system.signal_at=-1"]) == 0
    (whole,) = Path("outputs/whole").glob("*/ckpts/last.ckpt")
    assert_same_training(trial() / "ckpts/last.ckpt", whole)
    assert "save/it6-test.mp4" in files(trial())


def test_stopped_during_validation_and_resumed_equals_never_stopped(launch, monkeypatch):
    assert launch("--train", "name=whole")[0] == 0
    with monkeypatch.context() as patch:
        patch.setattr(
            tiny_parts.TinySystem,
            "validation_step",
            lambda self, batch, batch_idx: os.kill(os.getpid(), signal.SIGTERM),
        )
        # the second view brings the second signal, which would end it at once
        code, out, _ = launch("--train", "data.views=1")
    assert code == 143 and "stopped at step 3" in out
    parsed = f"{trial()}/configs/parsed.yaml"
    assert launch("--train", f"resume={trial()}/ckpts/last.ckpt", config=parsed)[0] == 0
    (whole,) = Path("outputs/whole").glob("*/ckpts/last.ckpt")
    assert_same_training(trial() / "ckpts/last.ckpt", whole)


@pytest.mark.parametrize("where", ["configure", "on_fit_start"])
@pytest.mark.parametrize(("name", "code"), [("SIGINT", 130), ("SIGTERM", 143), ("SIGHUP", 129)])
def test_before_training_a_signal_ends_it_at_once(launch, monkeypatch, where, name, code):
    monkeypatch.setattr(
        tiny_parts.TinySystem, where, lambda self: os.kill(os.getpid(), getattr(signal, name))
    )
    assert launch("--train")[0] == code and os.listdir() == ["tiny.yaml"]


def test_a_resumed_run_keeps_its_first_configuration_and_adds_its_command(launch, trained):
    code, _, _ = launch(
        "--train",
        f"resume={trained}/ckpts/last.ckpt",
        "trainer.max_steps=8",
        config=f"{trained}/configs/parsed.yaml",
    )
    assert code == 0 and trial() == trained
    assert (trained / "configs/raw.yaml").read_text() == tiny_parts.CONFIG
    assert load_config(trained / "configs/parsed.yaml").trainer.max_steps == 8
    assert len((trained / "cmd.txt").read_text().splitlines()) == 2
    # every_n_train_steps is still 6 there, but the last step is always kept
    assert load_file(trained / "ckpts/last.ckpt")["global_step"] == 8 and not list(
        trained.glob("ckpts/last-v*")
    )


def test_resume_auto_goes_on_where_the_last_run_stopped(launch):
    assert launch("--train", "resume=auto", "system.signal_at=2")[0] == 130
    code, _, _ = launch("--train", "resume=auto")
    assert code == 0 and load_file(trial() / "ckpts/last.ckpt")["global_step"] == 6


def test_a_full_disk_is_named_and_the_earlier_checkpoint_stays(launch, monkeypatch):
    original = os.fsync

    def fsync(descriptor):
        if "step=4" in os.readlink(f"/proc/self/fd/{descriptor}"):
            raise OSError(28, "No space left on device")
        original(descriptor)

    monkeypatch.setattr(os, "fsync", fsync)
    code, _, err = launch("--train", "checkpoint.every_n_train_steps=2")
    assert code == 2 and "No space left on device" in err and "Traceback" not in err
    assert load_file(trial() / "ckpts/last.ckpt")["global_step"] == 2 and not list(
        trial().glob("ckpts/.*")
    )


def test_ctrl_c_during_the_test_ends_with_130(launch, monkeypatch):
    monkeypatch.setattr(
        tiny_parts.TinySystem,
        "test_step",
        lambda self, batch, batch_idx: os.kill(os.getpid(), signal.SIGINT),
    )
    code, _, err = launch("--train")
    assert code == 130 and "Traceback" not in err
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    assert load_file(trial() / "ckpts/last.ckpt")["global_step"] == 6


def test_a_second_ctrl_c_stops_at_once(launch, monkeypatch):
    def endless_step(self, batch, batch_idx):
        os.kill(os.getpid(), signal.SIGINT)
        os.kill(os.getpid(), signal.SIGINT)
        time.sleep(60)

    monkeypatch.setattr(tiny_parts.TinySystem, "training_step", endless_step)
    code, _, _ = launch("--train")
    assert code == 130 and not Path("outputs").exists()


def test_a_second_sigterm_stops_at_once_with_its_own_code(launch, monkeypatch):
    def endless_step(self, batch, batch_idx):
        os.kill(os.getpid(), signal.SIGTERM)
        os.kill(os.getpid(), signal.SIGTERM)
        time.sleep(60)

    monkeypatch.setattr(tiny_parts.TinySystem, "training_step", endless_step)
    assert launch("--train")[0] == 143


def test_under_nohup_a_hang_up_changes_nothing(launch):
    earlier = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        code, _, _ = launch("--train", "system.signal_at=2", "system.signal_name=SIGHUP")
    finally:
        signal.signal(signal.SIGHUP, earlier)
    assert code == 0 and load_file(trial() / "ckpts/last.ckpt")["global_step"] == 6


def test_a_closed_terminal_leaves_a_checkpoint(launch, monkeypatch):
    """The process loses its terminal in the middle of a step: it is sent SIGHUP, and whatever it
    writes from then on fails.
    """
    child, terminal = pty.fork()
    if child == 0:
        sys.stdout, sys.stderr = open(1, "w", closefd=False), open(2, "w", closefd=False)
        os._exit(main(["--config", "tiny.yaml", "--train", "trainer.max_steps=100000"]))
    os.set_blocking(terminal, False)
    while not list(Path().glob("outputs/tiny/*/csv_logs/version_0/metrics.csv")):
        assert os.waitpid(child, os.WNOHANG) == (0, 0)
        with contextlib.suppress(BlockingIOError):
            os.read(terminal, 1 << 16)
        time.sleep(0.01)
    os.close(terminal)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 129
    assert load_file(trial() / "ckpts/last.ckpt")["global_step"] > 0


@pytest.mark.parametrize("translated", [RecursionError, UserError, None])
def test_a_signal_during_imports_ends_it_whatever_becomes_of_its_exception(
    launch, monkeypatch, translated
):
    def importing(*arguments):
        try:
            os.kill(os.getpid(), signal.SIGTERM)
        except BaseException as error:
            if translated:
                raise translated("while importing") from error
        return 0

    monkeypatch.setattr(experiment, "run", importing)
    code, _, err = launch("--train")
    assert code == 143 and err == "stopped\n"


def test_a_checkpoint_is_written_about_every_minute(launch, monkeypatch):
    """So a run that is killed between its own checkpoints loses at most that much."""
    steps, clock = [], [0.0]

    def step_of_20_seconds(system, batch, batch_idx):
        clock[0] += 20.0
        steps.append((trial() / "ckpts/last.ckpt").is_file() and last_step())
        return training_step(system, batch, batch_idx)

    def last_step():
        return load_file(trial() / "ckpts/last.ckpt")["global_step"]

    training_step = tiny_parts.TinySystem.training_step
    monkeypatch.setattr(tiny_parts.TinySystem, "training_step", step_of_20_seconds)
    monkeypatch.setattr(callbacks.time, "monotonic", lambda: clock[0])
    assert launch("--train", "trainer.max_steps=8", "trainer.limit_val_batches=0")[0] == 0
    assert steps == [False, False, False, 3, 3, 3, 6, 6] and last_step() == 8


def test_checkpoints_take_a_hundredth_of_the_time_at_most(launch, monkeypatch):
    clock, saved = [0.0], []

    def slow_save(path, content):
        clock[0] += 5.0
        saved.append(content["global_step"])

    def step_of_100_seconds(system, batch, batch_idx):
        clock[0] += 100.0
        return training_step(system, batch, batch_idx)

    training_step = tiny_parts.TinySystem.training_step
    monkeypatch.setattr(tiny_parts.TinySystem, "training_step", step_of_100_seconds)
    monkeypatch.setattr(callbacks.time, "monotonic", lambda: clock[0])
    monkeypatch.setattr(checkpoints, "save_file", slow_save)
    options = ["trainer.max_steps=12", "trainer.limit_val_batches=0", "checkpoint.save_last=false"]
    assert launch("--train", *options)[0] == 0
    assert [step for step in saved if step < 12] == [1, 6, 11]


def test_the_handlers_are_put_back(launch):
    before = signal.getsignal(signal.SIGINT), signal.getsignal(signal.SIGTERM)
    assert launch("--train")[0] == 0
    assert launch("--train", "system.signal_at=1")[0] == 130
    assert (signal.getsignal(signal.SIGINT), signal.getsignal(signal.SIGTERM)) == before


def test_it_runs_outside_of_the_main_thread(launch):
    codes = []
    thread = threading.Thread(target=lambda: codes.append(launch("--train")[0]))
    thread.start()
    thread.join()
    assert codes == [0]


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
    copied = {name for name in files(trial() / "code/custom") if not name.endswith(".pyc")}
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
    callbacks.copy_sources(tmp_path / "source", tmp_path / "copy")
    assert files(tmp_path / "copy") == {"part.py"}


def test_a_configuration_that_vanishes_is_kept_as_it_was_read(launch, monkeypatch):
    monkeypatch.setattr(
        tiny_parts.TinySystem, "post_configure", lambda self: os.unlink("tiny.yaml")
    )
    assert launch("--train")[0] == 0
    assert Path(trial(), "configs/raw.yaml").read_text() == tiny_parts.CONFIG


def test_a_configuration_that_can_not_be_read_is_named(launch, monkeypatch):
    def vanished(path):
        raise FileNotFoundError(2, "No such file or directory", str(path))

    monkeypatch.setattr(Path, "read_bytes", vanished)
    code, _, err = launch("--train")
    assert code == 2 and "error: the configuration tiny.yaml can't be read" in err


@pytest.mark.parametrize("strategy", [None, "auto", "ddp"])
def test_several_gpus_train_replicas_of_one_cloud(launch, monkeypatch, strategy):
    """Also where the configuration says what the default is: DDP's own wrapper would keep the
    parameters that densification replaces.
    """
    built = []

    class Built(Exception):
        pass

    def build(section, owner, arguments):
        built.append(arguments)
        raise Built

    monkeypatch.setattr(run, "build", build)
    monkeypatch.setattr(experiment, "announce_device", lambda gpu: 2)
    with pytest.raises(Built):
        launch("--train", *([f"trainer.strategy={strategy}"] if strategy else []))
    assert isinstance(built[0]["strategy"], ReplicatedStrategy) and built[0]["devices"] == 2


# -- runs that meet --------------------------------------------------------------------------------

ONE_FOLDER = ["use_timestamp=false", "tag=run"]


def test_a_run_that_is_refused_leaves_the_folder_of_the_one_that_trains(launch, monkeypatch):
    """The refused run made the folder and is stopped before it asks for the lock; it goes on while
    the other one trains.
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


# -- as a command ----------------------------------------------------------------------------------


@pytest.mark.slow
def test_launch_py_with_parts_dropped_into_custom(tmp_path):
    """A real process: parts come from one file in custom/; the process gets a real Ctrl-C, and the
    printed line goes on.
    """
    (tmp_path / "custom").mkdir()
    (tmp_path / "custom" / "tiny_parts.py").write_text(Path(tiny_parts.__file__).read_text())
    (tmp_path / "tiny.yaml").write_text(
        tiny_parts.CONFIG.replace("max_steps: 6", "max_steps: 100000000")
    )
    environment = {**os.environ, "PYTHONPATH": "", "CUDA_VISIBLE_DEVICES": ""}
    command = [
        sys.executable,
        str(REPOSITORY / "launch.py"),
        "--config",
        "tiny.yaml",
        "--train",
        "trainer.limit_val_batches=0",
    ]
    process = subprocess.Popen(
        command,
        cwd=tmp_path,
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    deadline = time.monotonic() + 120
    # the TensorBoard file appears when training begins
    while not list(tmp_path.glob("outputs/tiny/*/csv_logs/version_0/metrics.csv")):
        assert process.poll() is None and time.monotonic() < deadline, process.communicate()
        time.sleep(0.05)
    process.send_signal(signal.SIGINT)
    out, err = process.communicate(timeout=60)
    assert process.returncode == 130 and "Traceback" not in err
    resume = shlex.split(re.search("to go on: (.*)", out)[1])
    step = int(re.search(r"stopped at step (\d+)", out)[1])
    resumed = subprocess.run(
        [sys.executable, *resume[1:], f"trainer.max_steps={step + 3}"],
        cwd=tmp_path,
        env=environment,
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert resumed.returncode == 0, resumed.stderr
    (last,) = tmp_path.glob("outputs/tiny/*/ckpts/last.ckpt")
    assert load_file(last)["global_step"] == step + 3


PRIOR_FILE = """
from dataclasses import dataclass
from threestudio_gaussiandreamer.host import register
from threestudio_gaussiandreamer.gaussians.point_cloud import PointCloud
from threestudio_gaussiandreamer.priors.base import Prior

@register("ring-prior")
class RingPrior(Prior):
    @dataclass
    class Config(Prior.Config):
        count: int = 64

    def generate(self, prompt, generator):
        points = generator.normal(size=(self.cfg.count, 3))
        colors = generator.random((self.cfg.count, 3)).astype("float32")
        return PointCloud((0.5 * points).astype("float32"), colors)
"""
GUIDANCE_FILE = '''
from dataclasses import dataclass
from threestudio_gaussiandreamer.host import BaseObject, register

@register("red-guidance")
class RedGuidance(BaseObject):
    @dataclass
    class Config(BaseObject.Config):
        strength: float = 1.0

    def __call__(self, rgb, prompt_utils, **batch):
        """Pulls every pixel towards red: the smallest guidance there is."""
        red = rgb.new_tensor([1.0, 0.0, 0.0])
        return {"loss_sds": self.cfg.strength * (rgb - red).square().mean()}
'''
OWN_CONFIG = """
name: own
tag: run
data_type: gaussiandreamer-datamodule
data: {width: 16, height: 16, batch_size: 2, eval_width: 16, eval_height: 16, n_test_views: 2}
system_type: gaussiandreamer-system
system:
  geometry_type: gaussiandreamer-cloud
  geometry: {prior_type: ring-prior, prior: {count: 32}}
  background_type: gaussiandreamer-background
  renderer_type: gaussiandreamer-splatting
  prompt_processor_type: plain-prompt-processor
  prompt_processor: {prompt: a red ring}
  guidance_type: red-guidance
  loss: {lambda_sds: 100.0}
trainer: {max_steps: 3, num_sanity_val_steps: 0, limit_val_batches: 0, enable_progress_bar: false}
"""


def test_a_prior_and_a_guidance_of_one_file_each_dropped_into_custom(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "")
    for name, source in (("ring_prior.py", PRIOR_FILE), ("red_guidance.py", GUIDANCE_FILE)):
        (tmp_path / "custom").mkdir(exist_ok=True)
        (tmp_path / "custom" / name).write_text(source)
    (tmp_path / "own.yaml").write_text(OWN_CONFIG)
    assert main(["--config", "own.yaml", "--train"]) == 0, capsys.readouterr().err
    (run,) = Path("outputs/own").iterdir()
    assert {
        "code/custom/ring_prior.py",
        "code/custom/red_guidance.py",
        "save/it3-test.mp4",
    } <= files(run)
    # misspelt keys of parts that come from custom/ are found too
    assert main(["--config", "own.yaml", "--train", "system.guidance.strenght=2"]) == 2
    assert "did you mean 'system.guidance.strength'" in capsys.readouterr().err
