"""What a worker makes of errors, and how often it tries."""

import errno
from types import SimpleNamespace
from unittest.mock import Mock

import pytest
import torch

from threestudio_gaussiandreamer import __version__
from threestudio_gaussiandreamer.core.errors import UserError
from threestudio_gaussiandreamer.farm import worker
from threestudio_gaussiandreamer.farm.board import Beat, Board
from threestudio_gaussiandreamer.farm.place import FAILED, STOPPED, AnotherRow, Place, Unreachable
from threestudio_gaussiandreamer.farm.recipe import Job, Recipe, Source
from threestudio_gaussiandreamer.farm.rows import Row
from threestudio_gaussiandreamer.farm.worker import NO_MEMORY, Worker, count_attempts
from threestudio_gaussiandreamer.launch import experiment
from threestudio_gaussiandreamer.launch.run_folder import FolderInUse

JOB = Job(Row("fox", "a fox"))


def caused(error, cause):
    error.__cause__ = cause
    return error


@pytest.mark.parametrize(
    ("error", "state"),
    [
        (UserError("no surface"), FAILED),
        (MemoryError(), NO_MEMORY),
        (torch.OutOfMemoryError("CUDA out of memory"), NO_MEMORY),
        (caused(UserError("the grid doesn't fit"), torch.OutOfMemoryError()), NO_MEMORY),
        (RuntimeError("[enforce fail] DefaultCPUAllocator: can't allocate memory"), NO_MEMORY),
        (caused(UserError("can't write"), OSError(errno.ENOSPC, "full")), worker.BLOCKED),
        (Unreachable("s3://a can't be reached"), worker.BLOCKED),
        (AnotherRow(JOB.row), worker.REFUSED),
        (OSError(errno.ENOENT, "no such file"), FAILED),
    ],
)
def test_errors_have_states(error, state):
    outcome = worker.outcome_of(error)
    assert outcome["state"] == state and outcome["error"]


def test_attempts_are_counted_in_the_session_and_in_all(tmp_path):
    assert [count_attempts(tmp_path, "one", JOB) for _ in range(2)] == [(1, 1), (2, 2)]
    assert count_attempts(tmp_path, "two", JOB) == (3, 1)
    # a row that has changed doesn't go on with the checkpoints of the other
    with pytest.raises(UserError, match="line 7 .*'fox' was begun in this farm with another"):
        count_attempts(tmp_path, "two", JOB._replace(row=JOB.row._replace(prompt="b", line=7)))


@pytest.mark.parametrize(
    ("text", "saves_memory", "counted", "kept"),
    [
        ("one host 7\none KEY host 7\n\none\n", False, (4, 4), True),
        ("one KEY host 7\n", True, (1, 1), False),
        ("saves_memory.txt: one KEY host 7\n", True, (2, 2), True),
        ("saves_memory.txt: one host 7\n", False, (1, 1), False),
        ("one KEY-saves_memory host 7\n", True, (2, 2), True),
    ],
)
def test_attempts_that_earlier_versions_noted(tmp_path, text, saves_memory, counted, kept):
    """Without a key, or with the key alone and a file that told the configuration."""
    folder = tmp_path / "fox"
    (folder / "ckpts").mkdir(parents=True)
    file, _, lines = text.rpartition(": ")
    if file:
        (folder / file).touch()
    (folder / "attempts.txt").write_text(lines.replace("KEY", JOB.row.key))
    job = JOB._replace(saves_memory=saves_memory)
    assert count_attempts(folder, "one", job) == counted
    assert (folder / "ckpts").exists() == kept


def setting(place):
    recipe = Recipe((Source("a.yaml", b""),), (), True, 1, Source("low.yaml", b""))
    return worker.Setting(recipe, place, None, ".", "now", retries=1)


@pytest.fixture
def place(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(worker, "keep_loaded", lambda: None)
    return Place(tmp_path)


def test_an_asset_is_given_up_after_its_retries(place, monkeypatch):
    # nothing of the worker goes on after it, as after a kill
    monkeypatch.setattr(Worker, "_run", Mock(side_effect=KeyboardInterrupt))
    for _ in range(2):
        with pytest.raises(KeyboardInterrupt):
            Worker().make(JOB, 0, setting(place))
    outcome = Worker().make(JOB, 0, setting(place))
    assert outcome["state"] == NO_MEMORY and "died or hung 2 times" in outcome["error"]


def test_a_folder_that_a_dying_process_still_holds_is_waited_for(place, monkeypatch):
    monkeypatch.setattr(worker.time, "sleep", lambda seconds: None)
    monkeypatch.setattr(worker.Heartbeat, "report", lambda self, beat: False)
    codes = [FolderInUse("held"), FolderInUse("held"), 128 + 15]
    run = Mock(**{"run.side_effect": codes})
    monkeypatch.setattr(experiment, "prepare", Mock(return_value=run))
    outcome = Worker().make(JOB, 0, setting(place))
    assert outcome == {"state": STOPPED, "error": "stopped by signal 15"}
    assert run.run.call_count == experiment.prepare.call_count == 3


def test_a_machine_with_another_version_or_without_the_folder_is_named(place):
    other = f"has {__version__}; the farm is of 9.9"
    for wrong, value, said in (("version", "9.9", other), ("start", "/nowhere", "no folder /no")):
        outcome = Worker().make(JOB, 0, setting(place)._replace(**{wrong: value}))
        assert outcome["state"] == FAILED and said in outcome["error"]


def test_an_asset_without_files_has_failed(place, monkeypatch):
    """Such as one whose run has written to another folder."""
    run = Mock(**{"trainer.global_step": 5})
    monkeypatch.setattr(Worker, "_run", lambda *args: (run, 0))
    outcome = Worker().make(JOB, 0, setting(place))
    assert outcome["state"] == FAILED and "has left no files in" in outcome["error"]
    assert place.finished(JOB.row) is None


def test_an_exit_of_a_part_fails_its_asset_and_one_of_ray_ends_the_worker(place, monkeypatch):
    def exits(self, *args):
        exec("raise SystemExit(3)", {"__name__": module})

    monkeypatch.setattr(Worker, "_run", exits)
    module = "a_part"
    outcome = Worker().make(JOB, 0, setting(place))
    assert outcome["state"] == FAILED and "ended the run with sys.exit(3)" in outcome["error"]
    monkeypatch.setattr(Worker, "_run", Mock(side_effect=ValueError("no such thing")))
    other = Job(Row("cat", "a cat"))
    assert Worker().make(other, 0, setting(place))["error"] == "ValueError: no such thing"
    assert "Traceback" in (place.work_folder(other.row) / "log.txt").read_text()
    monkeypatch.setattr(Worker, "_run", exits)
    module = "ray._private.worker"
    with pytest.raises(SystemExit):
        Worker().make(JOB, 0, setting(place))


BEAT = Beat("fox", 1, "training", 3, 12)


def test_the_board_knows_since_when_nothing_has_changed(monkeypatch):
    now = SimpleNamespace(seconds=0.0)
    monkeypatch.setattr(worker.time, "monotonic", lambda: now.seconds)
    found = Board()
    assert found.report(0, BEAT) is False
    now.seconds = 5.0
    found.report(0, BEAT)
    assert found.read() == {0: (BEAT, 5.0)}
    found.report(0, BEAT._replace(step=4))
    assert found.read()[0][1] == 0.0
    found.stop()
    assert found.report(0, BEAT) is True


def test_reports_are_rare_and_a_run_is_stopped_once(monkeypatch):
    now = SimpleNamespace(seconds=0.0)
    monkeypatch.setattr(worker.time, "monotonic", lambda: now.seconds)
    told, stops, setting = [], [], Mock()
    monkeypatch.setattr(worker.signal, "raise_signal", stops.append)
    report = lambda _, beat: told.append(beat) or len(told) > 2  # noqa: E731
    monkeypatch.setattr(worker.Heartbeat, "report", report)
    beats = worker.Heartbeat(JOB, 1, 0, setting)
    for _ in range(4):
        now.seconds += 0.5
        beats.on_train_batch_end(SimpleNamespace(global_step=3, max_steps=12))
    assert [beat.stage for beat in told] == ["starting", "training", "training"]
    now.seconds = 9.0
    beats.on_train_batch_end(SimpleNamespace(global_step=4, max_steps=12))
    assert told[-1] == BEAT._replace(step=4)
    assert setting.place.keep_checkpoint.call_count == 5
    assert stops == [worker.signal.SIGTERM]
