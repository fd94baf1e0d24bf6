"""What a worker makes of errors, and how often it tries."""

import errno
from types import SimpleNamespace

import pytest
import torch

from threestudio_gaussiandreamer import __version__
from threestudio_gaussiandreamer.core.errors import UserError
from threestudio_gaussiandreamer.farm import worker
from threestudio_gaussiandreamer.farm.place import (
    FAILED,
    STOPPED,
    AnotherRow,
    Place,
    Unreachable,
)
from threestudio_gaussiandreamer.farm.recipe import Job, Recipe, Source
from threestudio_gaussiandreamer.farm.rows import Row
from threestudio_gaussiandreamer.farm.worker import (
    BLOCKED,
    NO_MEMORY,
    REFUSED,
    Setting,
    Worker,
    count_attempts,
    outcome_of,
)
from threestudio_gaussiandreamer.launch import experiment
from threestudio_gaussiandreamer.launch.folder_lock import FolderInUse

JOB = Job(Row("fox", "a fox"))


def caused(error, cause):
    error.__cause__ = cause
    return error


@pytest.mark.parametrize(
    ("error", "state"),
    [
        (UserError("no surface"), FAILED),
        (KeyError("x"), FAILED),
        (MemoryError(), NO_MEMORY),
        (torch.OutOfMemoryError("CUDA out of memory"), NO_MEMORY),
        (caused(UserError("the grid doesn't fit"), torch.OutOfMemoryError()), NO_MEMORY),
        (RuntimeError("[enforce fail] DefaultCPUAllocator: can't allocate memory"), NO_MEMORY),
        (OSError(errno.ENOSPC, "No space left on device"), BLOCKED),
        (caused(UserError("can't write"), OSError(errno.ENOSPC, "full")), BLOCKED),
        (Unreachable("s3://a can't be reached"), BLOCKED),
        (AnotherRow(JOB.row), REFUSED),
        (OSError(errno.ENOENT, "no such file"), FAILED),
    ],
)
def test_errors_have_states(error, state):
    outcome = outcome_of(error)
    assert outcome["state"] == state and outcome["error"]


def test_attempts_are_counted_in_the_session_and_in_all(tmp_path):
    (tmp_path / "attempts.txt").write_text("zero host 7\n")  # of an earlier version
    assert [count_attempts(tmp_path, "one", JOB) for _ in range(2)] == [(2, 1), (3, 2)]
    assert count_attempts(tmp_path, "two", JOB) == (4, 1)


def test_a_row_that_has_changed_does_not_go_on_with_the_checkpoints_of_the_other(tmp_path):
    count_attempts(tmp_path, "one", JOB)
    with pytest.raises(UserError, match="line 7 .*'fox' was begun in this farm with another"):
        count_attempts(tmp_path, "two", JOB._replace(row=JOB.row._replace(prompt="b", line=7)))


def setting(place, **options):
    recipe = Recipe((Source("a.yaml", b""),), (), True, 1, Source("low.yaml", b""))
    return Setting(recipe, place, None, options.pop("start", "."), "now", retries=1)


@pytest.fixture
def place(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(worker, "keep_loaded", lambda: None)
    return Place(tmp_path)


def test_an_asset_is_given_up_after_its_retries(place, monkeypatch):
    monkeypatch.setattr(Worker, "_run", dies)
    with pytest.raises(KeyboardInterrupt):
        Worker().make(JOB, 0, setting(place))
    with pytest.raises(KeyboardInterrupt):
        Worker().make(JOB, 0, setting(place))
    outcome = Worker().make(JOB, 0, setting(place))
    assert outcome["state"] == NO_MEMORY and "died or hung 2 times" in outcome["error"]


def dies(*args):
    raise KeyboardInterrupt  # nothing of the worker goes on after it, as after a kill


def test_what_was_made_with_much_memory_is_not_gone_on_with(place, monkeypatch):
    monkeypatch.setattr(Worker, "_run", dies)
    saving = JOB._replace(saves_memory=True)
    folder = place.work_folder(JOB.row)
    (folder / "ckpts").mkdir(parents=True)
    for expected in (False, True):
        with pytest.raises(KeyboardInterrupt):
            Worker().make(saving, 0, setting(place))
        assert (folder / "ckpts").exists() == expected
        (folder / "ckpts").mkdir(exist_ok=True)


def test_a_folder_that_a_dying_process_still_holds_is_waited_for(place, monkeypatch):
    monkeypatch.setattr(worker.time, "sleep", lambda seconds: None)
    monkeypatch.setattr(worker.Heartbeat, "report", lambda self, beat: False)
    codes = [FolderInUse("held"), FolderInUse("held"), 128 + 15]

    class Run:
        def run(self):
            code = codes.pop(0)
            if isinstance(code, Exception):
                raise code
            return code

    made = []
    monkeypatch.setattr(experiment, "prepare", lambda *args, **more: made.append(1) or Run())
    outcome = Worker().make(JOB, 0, setting(place))
    assert outcome == {"state": STOPPED, "error": "stopped by signal 15"}
    assert len(made) == 3 and not codes


def test_a_machine_without_the_folder_is_named(place):
    outcome = Worker().make(JOB, 0, setting(place, start="/nowhere"))
    assert outcome["state"] == FAILED and "has no folder /nowhere" in outcome["error"]


def test_a_machine_with_another_version_is_named(place):
    with pytest.raises(UserError, match=f"has threestudio-.* {__version__}; the farm is of 9.9"):
        Worker().hello("9.9", ".", 1)
    outcome = Worker().make(JOB, 0, setting(place)._replace(version="9.9"))
    assert outcome["state"] == FAILED and "the farm is of 9.9" in outcome["error"]


def test_an_asset_without_files_has_failed(place, monkeypatch):
    """Such as one whose run has written to another folder."""
    run = SimpleNamespace(
        system=SimpleNamespace(geometry=None), trainer=SimpleNamespace(global_step=5)
    )
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
    module = "ray._private.worker"
    with pytest.raises(SystemExit):
        Worker().make(JOB, 0, setting(place))


def test_an_error_is_in_the_log_of_its_asset(place, monkeypatch):
    def fails(*args):
        raise ValueError("no such thing")

    monkeypatch.setattr(Worker, "_run", fails)
    assert Worker().make(JOB, 0, setting(place))["error"] == "ValueError: no such thing"
    assert "Traceback" in (place.work_folder(JOB.row) / "log.txt").read_text()
