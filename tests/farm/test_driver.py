"""The driver's decisions, with workers that return at once and a stand-in for Ray."""

import errno
from types import SimpleNamespace
from unittest.mock import Mock

import pytest

from threestudio_gaussiandreamer.core.errors import UserError
from threestudio_gaussiandreamer.farm.driver import Driver, plan_workers
from threestudio_gaussiandreamer.farm.place import FAILED, FINISHED, STOPPED, WAITING, Place
from threestudio_gaussiandreamer.farm.recipe import Job, Recipe, Source
from threestudio_gaussiandreamer.farm.rows import Row
from threestudio_gaussiandreamer.farm.worker import BLOCKED, NO_MEMORY, REFUSED, Beat, Setting

ROWS = [Row(f"toy{i}", f"toy {i}", i) for i in range(6)]
LOW = Source("low.yaml", b"")


class RayError(Exception): ...


class FakeRay:
    """Ray's calls that the driver makes; a handle returns an outcome, which may be an exception."""

    exceptions = SimpleNamespace(RayError=RayError)

    def __init__(self):
        self.restarted = []

    def wait(self, handles, num_returns=1, timeout=None):
        return handles[:num_returns], handles[num_returns:]

    def get(self, handle, timeout=None):
        if isinstance(outcome := handle(), Exception):
            raise outcome
        return outcome

    def kill(self, worker, no_restart):
        assert not no_restart
        self.restarted.append(worker)


def remote(call):
    def handle(*args):
        outcome = call(*args)
        return lambda: outcome

    return SimpleNamespace(remote=handle)


def finished(job):
    return {"state": FINISHED, "key": job.row.key, "seconds": 1.0}


class Bench:
    """A driver with one worker, and what it has done."""

    def __init__(self, path, answers, rows=ROWS, low_memory=LOW):
        recipe = Recipe((Source("a.yaml", b""),), (), True, 1, low_memory)
        self.place, self.answers = Place(path), answers
        self.ray, self.made, self.beats, self.stops = FakeRay(), [], {}, []
        stop = remote(lambda: self.stops.append(1))
        board = SimpleNamespace(read=remote(lambda: self.beats), stop=stop)
        workers = [SimpleNamespace(make=remote(self._make))]
        setting = Setting(recipe, self.place, board, "", "now", 3)
        jobs = iter([Job(row, spent=100.0) for row in rows])
        self.driver = Driver(self.ray, workers, setting, jobs, 10.0, len(rows), 0)

    def _make(self, job, number, setting):
        self.made.append(job)
        outcome = self.answers(job)
        if not isinstance(outcome, Exception) and outcome["state"] == FINISHED:
            self.place.publish(job.row, outcome)
        return outcome

    def records(self):
        return [record for _, record in self.place.records(ROWS)]

    def states(self):
        return [record["state"] for record in self.records()]


FAILS = {"state": FAILED, "error": "no surface"}
NO = {"state": NO_MEMORY, "error": "out of memory"}
REST = [FINISHED] * 5


def first_is(outcome, **when):
    """Return answers that finish every asset but the first, unless its job is another one."""

    def answers(job):
        alike = all(getattr(job, name) == value for name, value in when.items())
        return outcome if job.row == ROWS[0] and alike else finished(job)

    return answers


def stopped_once():
    outcomes = [{"state": STOPPED, "error": "stopped by signal 15"}]
    return lambda job: outcomes.pop() if outcomes else finished(job)


@pytest.mark.parametrize(
    ("answers", "low_memory", "states", "error"),
    [
        (finished, LOW, [FINISHED, *REST], None),
        (first_is(FAILS), LOW, [FAILED, *REST], "no surface"),
        (first_is(RayError("killed")), LOW, [FAILED, *REST], "its worker"),
        (first_is(NO, saves_memory=False), LOW, [FINISHED, *REST], None),
        (first_is(NO), LOW, [FAILED, *REST], "out of memory"),
        (first_is(NO), None, [FAILED, *REST], "out of memory"),
        # nothing is written beside what another row has made
        (first_is({"state": REFUSED, "error": "of another"}), LOW, [WAITING, *REST], None),
        # as when its machine is drained
        (stopped_once(), LOW, [FINISHED, *REST], None),
        (lambda job: FAILS | {"error": job.row.name}, LOW, [FAILED] * 6, "toy0"),
    ],
)
def test_what_becomes_of_an_asset(tmp_path, capsys, answers, low_memory, states, error):
    bench = Bench(tmp_path, answers, low_memory=low_memory)
    bench.place.write = Mock(wraps=bench.place.write)
    bench.driver.run()
    noted = [call.args[1] for call in bench.place.write.call_args_list]
    assert bench.states() == states and not bench.stops
    record, said = bench.records()[0], capsys.readouterr().err
    assert "toy5: f" in said and (answers is not finished or "(1 of 6, 00:00 left)" in said)
    tries = [job for job in bench.made if job.row == ROWS[0]]
    saving = any(job.saves_memory for job in tries)
    assert len(bench.ray.restarted) == saving
    assert tries[0].spent == 100 and all(job.spent >= 100 for job in tries)
    if error:
        assert record["error"].startswith(error) and record["worker_seconds"] >= 100
        assert "prompt=toy 0" in record["command"] and ("low.yaml" in record["command"]) == saving
    elif saving:  # noted before the second attempt, for a driver that is killed
        (first,) = (note for note in noted if "error" in note)
        assert first["saves_memory"] is True and "low.yaml" in first["command"]
    assert (tmp_path / "assets/toy0/failed.json").exists() == bool(error)


def test_obstacles_end_the_farm_and_leave_the_assets_to_the_next(tmp_path, monkeypatch):
    full = {"state": BLOCKED, "error": "No space left"}
    bench = Bench(tmp_path / "a", lambda job: full if job.row == ROWS[2] else finished(job))
    with pytest.raises(UserError, match="No space left"):
        bench.driver.run()
    assert bench.states() == [FINISHED, FINISHED, STOPPED, *[WAITING] * 3] and bench.stops
    bench = Bench(tmp_path / "b", lambda job: {"state": FAILED, "error": "no model"})
    with pytest.raises(UserError, match="first 3 assets have failed alike.*no model"):
        bench.driver.run()
    assert len(bench.made) == 3
    bench = Bench(tmp_path / "c", lambda job: FAILS)
    full = Mock(side_effect=OSError(errno.ENOSPC, "no space left"))
    monkeypatch.setattr("pathlib.Path.mkdir", full)  # the record of the failure
    with pytest.raises(UserError, match="no space left"):
        bench.driver.run()
    assert len(bench.made) == 1 and bench.stops


def test_a_worker_that_hangs_is_restarted_once_for_each_standstill(tmp_path):
    bench = Bench(tmp_path, finished, rows=ROWS[:1])
    bench.driver.fill()
    for beat, seconds, restarts in (
        (Beat("toy0", 1, "training", 3, 9), 9.0, 0),
        (Beat("toy0", 1, "training", 3, 9), 11.0, 1),
        (Beat("toy0", 1, "training", 3, 9), 12.0, 1),
        (Beat("toy0", 2, "starting", 0, 0), 1.0, 1),
        (Beat("toy0", 2, "starting", 0, 0), 11.0, 2),
        (Beat("earlier", 1, "rendering", 1, 0), 99.0, 2),
    ):
        bench.beats = {0: (beat, seconds)}
        bench.driver.look_after_workers()
        assert len(bench.ray.restarted) == restarts, beat


def test_ctrl_c_lets_the_workers_write_checkpoints(tmp_path):
    def answers(job):
        if job.row == ROWS[1]:
            bench.driver.fill = Mock(side_effect=KeyboardInterrupt)
        return finished(job) if job.row == ROWS[0] else {"state": STOPPED, "error": "stopped"}

    bench = Bench(tmp_path, answers)
    with pytest.raises(KeyboardInterrupt):
        bench.driver.run()
    assert len(bench.stops) == 1 and bench.states() == [FINISHED, STOPPED, *[WAITING] * 4]


CPU, GPUS = {"CPU": 8.0}, {"CPU": 8.0, "GPU": 2.0}


@pytest.mark.parametrize(
    ("resources", "gpus", "cores", "workers", "plan"),
    [
        (GPUS, None, 1, None, (2, 1)),
        (GPUS, 1, 1, None, (1, 1)),
        (GPUS, None, 5, None, (1, 1)),
        (GPUS, 0, 1, None, (8, 0)),
        (CPU, None, 3, None, (2, 0)),
        (CPU, None, 1, 3, (3, 0)),
        (CPU, 1, 1, None, "--gpus 1: the cluster has no GPU; give none"),
        (CPU, None, 9, None, "--cores 9: the cluster has 8 cores"),
        (GPUS, None, 1, 3, "with 1 GPU each, 2 fit"),
    ],
)
def test_as_many_workers_start_as_fit(resources, gpus, cores, workers, plan):
    """With a GPU each where there are some."""
    if isinstance(plan, tuple):
        assert plan_workers(resources, gpus, cores, workers) == plan
        return
    with pytest.raises(UserError, match=plan):
        plan_workers(resources, gpus, cores, workers)
