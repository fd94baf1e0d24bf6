"""A5: runs that are killed, interrupted, or run out of disk."""

import contextlib
import ctypes
import io
import os
import random
import signal
import struct
import time
from pathlib import Path

import numpy as np
import pytest
import torch

from tests.promises.commands import full_disk
from tests.stability.rows import row
from tests.stability.run_failures_cases import EVERY_STEP, content
from tests.stability.small_runs import Ended, launch, require_equal_ends
from threestudio_gaussiandreamer import register_parts
from threestudio_gaussiandreamer.core import images as pictures
from threestudio_gaussiandreamer.core.checkpoint_file import (
    load_checkpoint,
    previous_of,
    save_file,
)
from threestudio_gaussiandreamer.core.errors import UserError
from threestudio_gaussiandreamer.training import system
from threestudio_gaussiandreamer.training.system import GaussianDreamerSystem

register_parts()


def at_step(monkeypatch, step, act) -> None:
    """Call ``act(system)`` after so many steps, before the checkpoint of that step is written."""
    training_step = GaussianDreamerSystem.training_step

    def wrapped(self, batch, batch_idx):
        training_step(self, batch, batch_idx)
        if self.global_step == step:
            act(self)

    monkeypatch.setattr(GaussianDreamerSystem, "training_step", wrapped)


@pytest.mark.slow
@row("A5", "Crash mid checkpoint")
def test_killed_at_random_moments_of_200_saves(tmp_path, measured):
    """After each kill the file is intact and not older than the last save that the child has
    reported.
    """
    path, rng = tmp_path / "last.ckpt", random.Random(0)
    save_file(path, content(0))
    saved, kills, read_end_lost = 0, 0, 0
    while saved < 200 or kills < 20:
        read_end, write_end = os.pipe()
        child = os.fork()
        if child == 0:
            # only torch.save and files, which need none of the threads that a fork loses
            for step in range(saved + 1, 10_000):
                save_file(path, content(step))
                os.write(write_end, struct.pack("i", step))
        os.close(write_end)
        time.sleep(rng.uniform(0.01, 0.08))
        os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)
        told = os.read(read_end, 1 << 16)
        os.close(read_end)
        kills, told = kills + 1, struct.unpack("i", told[-4:])[0] if told else saved
        found = load_checkpoint(path)
        assert found["state_dict"]["means"].equal(
            content(found["global_step"])["state_dict"]["means"]
        )
        read_end_lost += max(0, told - found["global_step"])
        if previous_of(path).exists():
            assert load_checkpoint(previous_of(path))["global_step"] <= found["global_step"]
        saved = found["global_step"]
    save_file(path, content(saved + 1))
    assert {entry.name for entry in tmp_path.iterdir()} <= {
        "last.ckpt",
        "last-prev.ckpt",
    }  # partially written files are gone
    measured(kills, "kills", what="kills in 200 saves or more", at_least=20)
    measured(read_end_lost, "saves", what="lost", at_most=0)


@row("A5", "Crash mid checkpoint")
def test_a_file_written_in_place_is_lost_by_such_kills(tmp_path, measured):
    """Shows that the test above can fail: the same kills of a child that saves with
    ``torch.save(content, path)`` leave damaged files.
    """
    path, rng, lost = tmp_path / "last.ckpt", random.Random(0), 0
    for _ in range(20):
        save_file(path, content(0))
        child = os.fork()
        if child == 0:
            while True:
                buffer = io.BytesIO()
                torch.save(content(1), buffer)
                with open(path, "wb") as file:
                    file.write(buffer.getvalue())
                    os.fsync(file.fileno())
        time.sleep(rng.uniform(0.01, 0.08))
        os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)
        try:
            load_checkpoint(path)
        except UserError:
            lost += 1
    assert lost
    measured("such kills damage a file that is written in place")


@contextlib.contextmanager
def permissions_count_for_root():
    """Make permissions effective for root by dropping two capabilities of the thread for
    a while.
    """
    if os.geteuid():
        yield
        return
    libc = ctypes.CDLL(None, use_errno=True)
    header, before, without = (
        (ctypes.c_uint32 * 2)(0x20080522, 0),
        (ctypes.c_uint32 * 6)(),
        (ctypes.c_uint32 * 6)(),
    )
    if libc.capget(header, before):
        pytest.skip("this system doesn't tell its capabilities")
    without[:] = before[:]
    without[
        0
    ] &= (
        ~0b110
    )  # DAC_OVERRIDE and DAC_READ_SEARCH are 1 and 2; the first number holds what is in effect
    libc.capset(header, without)
    try:
        yield
    finally:
        libc.capset(header, before)


def assert_stopped_cleanly(ended: Ended, message: str) -> None:
    """One named error; the checkpoint of step 2 is intact and the newest, and no temporary file is
    left.
    """
    assert ended.code == 2 and "Traceback" not in ended.err, ended.err
    assert (
        sum(line.startswith("error: ") for line in ended.err.splitlines()) == 1
        and message in ended.err
    ), ended.err
    assert load_checkpoint(ended.last)["global_step"] == 2
    assert not [
        path for path in ended.folder.rglob("*") if path.suffix == ".tmp" or "step=3" in path.name
    ]


@row("A5", "Disk full, read-only")
def test_a_full_disk_in_the_middle_of_a_run(tmp_path, monkeypatch, measured):
    with contextlib.ExitStack() as full:
        at_step(monkeypatch, 3, lambda _: full.enter_context(full_disk(2000)))
        ended = launch(tmp_path, *EVERY_STEP)
    assert_stopped_cleanly(ended, "File too large")
    measured("named error, exit code 2, earlier file intact, no temporary")


@row("A5", "Disk full, read-only")
@pytest.mark.parametrize(
    "hook", ["ensure_cloud", "score", "on_test_start", "on_test_epoch_end", "export"]
)
def test_a_disk_that_is_full_by_then(hook, tmp_path, monkeypatch, measured):
    """While the prior is cached, the cloud evaluated, views and video written, or the cloud
    exported: a partial file never counts as success.
    """
    owner = system if hook == "export" else GaussianDreamerSystem
    original = getattr(owner, hook)
    with contextlib.ExitStack() as full:

        def wrapped(self, *args):
            full.enter_context(full_disk(100))
            return original(self, *args)

        monkeypatch.setattr(owner, hook, wrapped)
        ended = launch(tmp_path, "trainer.max_steps=1", "data.eval_width=64", "data.eval_height=64")
    assert (
        ended.code == 2 and sum(line.startswith("error: ") for line in ended.err.splitlines()) == 1
    ), ended.err
    assert "Traceback" not in ended.err and (
        "cannot write" in ended.err or "could not be written" in ended.err
    )
    assert not [
        path
        for path in ended.folder.rglob("*")
        if path.suffix == ".tmp" or path.name.startswith(".part")
    ]
    measured("named error at every place that writes")


@row("A5", "Disk full, read-only")
@pytest.mark.parametrize("kind", ["mp4", "gif", "png"])
@pytest.mark.parametrize("limit", [0, 100, 3000])
def test_a_partial_video_is_an_error(kind, limit, tmp_path, measured):
    """The encoder is a separate process that may end without an error: an mp4 counts as written
    when it contains its index.
    """
    noise = np.random.default_rng(0).integers(0, 255, (4, 64, 64, 3), dtype=np.uint8)
    for i, frame in enumerate(noise):
        pictures.write(tmp_path / f"{i}.png", frame)
    frames = [tmp_path / f"{i}.png" for i in range(4)]
    path = tmp_path / f"out.{kind}"

    def write() -> None:
        pictures.write(path, noise[0]) if kind == "png" else pictures.write_video(
            str(path), frames, fps=5
        )

    with full_disk(limit), pytest.raises(UserError, match=f"out.{kind}"):
        write()
    assert not path.exists()
    write()
    whole = path.read_bytes()
    with full_disk(limit), pytest.raises(UserError):
        write()
    assert path.read_bytes() == whole and len(list(tmp_path.iterdir())) == 5
    measured("named error, earlier file intact")


@row("A5", "Disk full, read-only")
def test_a_folder_that_becomes_read_only(tmp_path, monkeypatch, measured):
    with contextlib.ExitStack() as locked:

        def lock(system):
            folder = Path(system._save_dir).parent / "ckpts"
            locked.enter_context(permissions_count_for_root())
            folder.chmod(0o555)
            locked.callback(folder.chmod, 0o755)

        at_step(monkeypatch, 3, lock)
        ended = launch(tmp_path, *EVERY_STEP)
    assert_stopped_cleanly(ended, "Permission denied")
    measured("named error, exit code 2, earlier file intact, no temporary")


@row("A5", "Disk full, read-only")
def test_a_read_only_output_root_is_named_before_any_work(tmp_path, measured):
    tmp_path.chmod(0o555)
    with permissions_count_for_root():
        ended = launch(tmp_path, *EVERY_STEP)
    tmp_path.chmod(0o755)
    assert (
        ended.code == 2
        and "can't be written: Permission denied" in ended.err
        and "the cloud starts" not in ended.err
    )
    assert not list(tmp_path.iterdir())
    measured("named before any work")


# ---- signals -------------------------------------------------------------------------------------


def require_resumed_equal(tmp_path, ended, whole, measured) -> None:
    """Resume a stopped run to its end; fail unless it ends as the undisturbed run ``whole``."""
    finished = launch(tmp_path, *EVERY_STEP, f"resume={ended.last}")
    assert finished.code == 0, finished.err
    require_equal_ends(measured, whole, finished, "different after resuming")


@row("A5", "Ctrl-C / SIGTERM")
@pytest.mark.parametrize("name, code", [("SIGINT", 130), ("SIGTERM", 143), ("SIGHUP", 129)])
@pytest.mark.parametrize("step", random.Random(5).sample(range(1, 5), 2))
def test_a_signal_at_a_random_step(name, code, step, whole, tmp_path, monkeypatch, measured):
    with monkeypatch.context() as patch:
        at_step(patch, step, lambda _: os.kill(os.getpid(), getattr(signal, name)))
        ended = launch(tmp_path, "trainer.max_steps=5")
    assert (
        ended.code == code
        and f"stopped at step {step}; to resume: " in ended.out
        and f"resume={ended.last}" in ended.out
    ), ended.err
    assert load_checkpoint(ended.last)["global_step"] == step
    assert not list(ended.folder.glob("save/*test*"))  # Lightning would continue with the test
    require_resumed_equal(tmp_path, ended, whole, measured)


@row("A5", "Ctrl-C / SIGTERM")
def test_a_signal_while_views_are_validated(whole, tmp_path, monkeypatch, measured):
    """The checkpoint of that step is written once the views are done."""
    with monkeypatch.context() as patch:
        patch.setattr(
            GaussianDreamerSystem,
            "on_validation_epoch_end",
            lambda _: os.kill(os.getpid(), signal.SIGTERM),
        )
        ended = launch(
            tmp_path,
            "trainer.max_steps=5",
            "trainer.limit_val_batches=1",
            "trainer.val_check_interval=3",
        )
    assert ended.code == 143 and "stopped at step 3; to resume: " in ended.out, ended.err
    require_resumed_equal(tmp_path, ended, whole, measured)


@row("A5", "Ctrl-C / SIGTERM")
def test_a_second_signal_stops_at_once(tmp_path, monkeypatch, measured):
    """In the middle of a step: the checkpoint of the previous step remains, and the run can be
    resumed.
    """

    def impatient(system):
        os.kill(os.getpid(), signal.SIGINT)
        os.kill(os.getpid(), signal.SIGINT)

    at_step(monkeypatch, 3, impatient)
    ended = launch(tmp_path, *EVERY_STEP)
    assert (
        ended.code == 130 and "Traceback" not in ended.err and f"resume={ended.last}" in ended.out
    ), ended.err
    measured(
        3 - load_checkpoint(ended.last)["global_step"],
        "steps",
        what="lost by a second signal",
        at_most=1,
    )
