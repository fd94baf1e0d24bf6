"""Stopping by signals, checkpoints, and resuming."""

import contextlib
import os
import pty
import re
import shlex
import signal
import sys
import threading
import time
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

from tests.helpers import tiny_parts
from tests.helpers.gallery import assert_same_training, files, only_run
from threestudio_gaussiandreamer.core.checkpoint_file import load_file
from threestudio_gaussiandreamer.core.devices import DelayedReads, HostCopy
from threestudio_gaussiandreamer.core.errors import UserError
from threestudio_gaussiandreamer.launch import callbacks
from threestudio_gaussiandreamer.launch.config import load_config
from threestudio_gaussiandreamer.launch.experiment import main

SIGNALS = {"SIGINT": 130, "SIGTERM": 143, "SIGHUP": 129}


def test_stopped_and_resumed_equals_never_stopped(launch, monkeypatch):
    """Resumed by the printed command, from another folder."""
    handlers = [signal.getsignal(getattr(signal, name)) for name in SIGNALS]
    assert launch("--train", "name=whole")[0] == 0
    (whole,) = Path("outputs/whole").glob("*/ckpts/last.ckpt")
    whole = whole.absolute()
    home, _ = os.getcwd(), Path("elsewhere").mkdir()
    # step 2 is followed by validation, step 5 is the last one
    for step, (name, code) in zip((0, 2, 5), SIGNALS.items(), strict=True):
        arguments = f"name={name}", f"system.signal_at={step}", f"system.signal_name={name}"
        stopped, out, _ = launch("--train", *arguments)
        (run,) = Path("outputs", name).iterdir()
        run = run.absolute()
        assert stopped == code and f"stopped at step {step + 1}" in out
        assert "it6-test" not in str(files(run))
        assert load_file(run / "ckpts/last.ckpt")["global_step"] == step + 1
        command = shlex.split(re.search("to resume: (.*)", out)[1])
        options = command[command.index("--config") :]
        assert options[1] == f"{run}/configs/parsed.yaml"
        os.chdir("elsewhere")
        assert main([*options, "system.signal_at=-1"]) == 0 and not os.listdir()
        os.chdir(home)
        assert_same_training(run / "ckpts/last.ckpt", whole)
        assert "save/it6-test.mp4" in files(run)
    assert handlers == [signal.getsignal(getattr(signal, name)) for name in SIGNALS]

    with monkeypatch.context() as patch:
        patch.setattr(tiny_parts.TinySystem, "validation_step", sends(signal.SIGTERM))
        # the second view brings the second signal, which would end it at once
        code, out, _ = launch("--train", "data.views=1")
    assert code == 143 and "stopped at step 4" in out
    parsed = f"{only_run()}/configs/parsed.yaml"
    assert launch("--train", f"resume={only_run()}/ckpts/last.ckpt", config=parsed)[0] == 0
    assert_same_training(only_run() / "ckpts/last.ckpt", whole)


def sends(signum):
    """Return a method that sends a signal to this process."""
    return lambda self, *arguments: os.kill(os.getpid(), signum)


def test_before_training_a_signal_ends_it_at_once(launch, monkeypatch):
    places = ("configure", "on_fit_start", "on_fit_start")
    for where, (name, code) in zip(places, SIGNALS.items(), strict=True):
        with monkeypatch.context() as patch:
            patch.setattr(tiny_parts.TinySystem, where, sends(getattr(signal, name)))
            assert launch("--train")[0] == code and os.listdir() == ["tiny.yaml"]


def test_a_resumed_run_keeps_its_first_configuration_and_adds_its_command(launch, trained):
    again = [f"resume={trained}/ckpts/last.ckpt", "trainer.max_steps=8"]
    code, _, _ = launch("--train", *again, config=f"{trained}/configs/parsed.yaml")
    assert code == 0 and only_run() == trained
    assert (trained / "configs/raw.yaml").read_text() == tiny_parts.CONFIG
    assert load_config(trained / "configs/parsed.yaml").trainer.max_steps == 8
    assert len((trained / "cmd.txt").read_text().splitlines()) == 2
    # every_n_train_steps is still 6 there, but the last step is always kept
    assert load_file(trained / "ckpts/last.ckpt")["global_step"] == 8
    assert not list(trained.glob("ckpts/last-v*"))


@pytest.mark.parametrize("error", [ValueError, UserError])
def test_an_error_after_training_prints_the_command_and_stays(launch, monkeypatch, capsys, error):
    def fail(self, batch, batch_idx):
        raise error("of the test")

    monkeypatch.setattr(tiny_parts.TinySystem, "test_step", fail)
    if error is UserError:
        code, out, _ = launch("--train")
        assert code == 2
    else:
        with pytest.raises(error, match="of the test"):
            launch("--train")
        out = capsys.readouterr().out
    assert f"resume={only_run().absolute()}/ckpts/last.ckpt" in out
    # the results of the training are listed all the same
    assert f"results are in {only_run()}/save" in out and (only_run() / "index.html").is_file()


def test_ctrl_c_during_the_test_ends_with_130(launch, monkeypatch):
    with monkeypatch.context() as patch:
        patch.setattr(tiny_parts.TinySystem, "test_step", sends(signal.SIGINT))
        code, out, err = launch("--train")
    last = only_run().absolute() / "ckpts/last.ckpt"
    assert code == 130 and "Traceback" not in err
    assert "to resume: " in out and f"resume={last}" in out
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    assert load_file(last)["global_step"] == 6
    parsed = f"{only_run()}/configs/parsed.yaml"
    assert launch("--train", f"resume={last}", config=parsed)[0] == 0
    assert "save/it6-test.mp4" in files(only_run())


def test_under_nohup_a_hang_up_changes_nothing(launch):
    earlier = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        code, _, _ = launch("--train", "system.signal_at=2", "system.signal_name=SIGHUP")
    finally:
        signal.signal(signal.SIGHUP, earlier)
    assert code == 0 and load_file(only_run() / "ckpts/last.ckpt")["global_step"] == 6


def test_a_closed_terminal_leaves_a_checkpoint(launch, monkeypatch):
    """In the middle of a step: the process receives SIGHUP, and all later writes fail."""
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
    assert load_file(only_run() / "ckpts/last.ckpt")["global_step"] > 0


@pytest.mark.parametrize("times, steps", [((20, 0), [3, 6, 9]), ((100, 5), [1, 6, 11])])
def test_checkpoints_come_every_minute_and_take_a_hundredth(launch, monkeypatch, times, steps):
    """A run that is killed between its own checkpoints loses at most that much."""
    seconds, writing = times
    clock, saved, training_step = [0.0], [], tiny_parts.TinySystem.training_step

    def slow_step(system, batch, batch_idx):
        clock[0] += seconds
        return training_step(system, batch, batch_idx)

    def slow_save(path, content):
        clock[0] += writing
        saved.append(content["global_step"])

    monkeypatch.setattr(tiny_parts.TinySystem, "training_step", slow_step)
    monkeypatch.setattr(callbacks.time, "monotonic", lambda: clock[0])
    monkeypatch.setattr(callbacks, "save_file", slow_save)
    options = ["trainer.max_steps=12", "trainer.limit_val_batches=0", "checkpoint.save_last=false"]
    assert launch("--train", *options)[0] == 0
    assert [step for step in saved if step < 12] == steps and saved[-1] == 12


def test_it_runs_outside_of_the_main_thread(launch):
    codes = []
    thread = threading.Thread(target=lambda: codes.append(launch("--train")[0]))
    thread.start()
    thread.join()
    assert codes == [0]


def test_numbers_that_have_not_arrived_are_logged_when_an_exception_ends_training(monkeypatch):
    monkeypatch.setattr(HostCopy, "ready", lambda copy: False)
    log, seen = SimpleNamespace(reads=DelayedReads()), []
    log.reads.submit(torch.tensor(1.0), seen.append)
    last = callbacks.LastCheckpoint(Path(), None)
    last.on_exception(None, SimpleNamespace(step_log=log), KeyboardInterrupt())
    assert seen == [1.0]
    last.on_exception(None, object(), KeyboardInterrupt())  # another package's system
