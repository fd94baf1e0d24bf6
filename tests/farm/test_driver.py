"""The driver's decisions, with workers that return at once and a stand-in for Ray."""

import errno
import json
from types import SimpleNamespace

import pytest

from threestudio_gaussiandreamer.core.errors import UserError
from threestudio_gaussiandreamer.farm.driver import Driver
from threestudio_gaussiandreamer.farm.place import FAILED, FINISHED, STOPPED, WAITING, Place
from threestudio_gaussiandreamer.farm.recipe import Job, Recipe, Source
from threestudio_gaussiandreamer.farm.rows import Row
from threestudio_gaussiandreamer.farm.worker import BLOCKED, NO_MEMORY, REFUSED, Beat, Setting

ROWS = [Row(f"toy{i}", f"toy {i}", i) for i in range(6)]
LOW = Source("low.yaml", b"")


class FakeRay:
    """Ray's calls that the driver makes; an outcome may be an exception."""

    class exceptions:
        class RayError(Exception):
            pass

        class RayActorError(RayError):
            pass

    def __init__(self):
        self.restarted = []

    def wait(self, handles, num_returns=1, timeout=None):
        return handles[:num_returns], handles[num_returns:]

    def get(self, handle, timeout=None):
        if isinstance(handle.outcome, Exception):
            raise handle.outcome
        return handle.outcome

    def kill(self, worker, no_restart):
        assert not no_restart
        self.restarted.append(worker)


class Handle:
    """Of a call: its outcome, which is there at once."""

    def __init__(self, outcome):
        self.outcome = outcome


class FakeWorker:
    def __init__(self, place, answers):
        self.place, self.made = place, []
        self.make = SimpleNamespace(remote=self._make)
        self.answers = answers

    def _make(self, job, number, setting):
        self.made.append(job)
        outcome = self.answers(job)
        if not isinstance(outcome, Exception) and outcome["state"] == FINISHED:
            self.place.publish(job.row, outcome)
        return Handle(outcome)


def finished(job):
    return {"state": FINISHED, "key": job.row.key, "seconds": 1.0}


class Bench:
    """A driver with one worker, and what it has done."""

    def __init__(self, path, answers, rows=ROWS, low_memory=LOW, workers=1):
        recipe = Recipe((Source("a.yaml", b""),), (), True, 1, low_memory)
        self.place = Place(path)
        self.ray, self.worker = FakeRay(), FakeWorker(self.place, answers)
        self.beats, self.stops, self.reads = {}, 0, 0
        board = SimpleNamespace(
            read=SimpleNamespace(remote=self._read),
            stop=SimpleNamespace(remote=self._stop),
        )
        self.driver = Driver(
            self.ray,
            [self.worker] * workers,
            Setting(recipe, self.place, board, "", "now", 3),
            iter([Job(row, spent=100.0) for row in rows]),
            10.0,
            len(rows),
            0,
        )

    def _read(self):
        self.reads += 1
        return Handle(self.beats)

    def _stop(self):
        self.stops += 1
        return Handle(None)

    def records(self):
        return [record for _, record in self.place.records(ROWS)]

    def states(self):
        return [record["state"] for record in self.records()]


@pytest.fixture
def path(tmp_path):
    return tmp_path


def test_a_step_collects_all_outcomes_and_looks_after_workers_now_and_then(path):
    bench = Bench(path, finished, workers=3)
    bench.driver.fill()
    bench.driver.step()
    assert bench.driver.counts[FINISHED] == 3
    bench.driver.step()
    assert bench.driver.counts[FINISHED] == 6 and bench.reads == 1
    bench.driver.look_due = 0.0
    bench.driver.look_after_workers()
    assert bench.reads == 2


def test_the_seconds_of_every_attempt_are_kept(path):
    def answers(job):
        if job.saves_memory:
            return finished(job) | {"worker_seconds": job.worker_seconds(job.handed_out + 5)}
        return {"state": NO_MEMORY if job.row == ROWS[0] else FAILED, "error": job.row.name}

    bench = Bench(path, answers)
    bench.driver.run()
    found = [record["worker_seconds"] for record in bench.records()]
    assert found[0] >= 105 and all(100 <= seconds < 105 for seconds in found[1:])
    assert not (path / "assets/toy0/failed.json").exists()


def test_every_asset_is_made_once(path, capsys):
    bench = Bench(path, finished)
    bench.driver.run()
    assert [job.row for job in bench.worker.made] == ROWS
    assert bench.states() == [FINISHED] * 6
    said = capsys.readouterr().err
    assert "toy0: finished: 1.0 s (1 of 6, 00:00 left)" in said and "toy5: finished: 1.0 s" in said


def test_a_failed_asset_stops_no_other_and_is_reported_with_its_command(path):
    def answers(job):
        failed = {"state": FAILED, "error": "no surface"}
        return failed if job.row == ROWS[1] else finished(job)

    bench = Bench(path, answers)
    bench.driver.run()
    assert bench.states() == [FINISHED, FAILED, *[FINISHED] * 4]
    line = bench.records()[1]
    assert line["error"] == "no surface" and "prompt=toy 1" in line["command"]


def test_an_asset_whose_worker_can_not_be_restarted_is_given_up(path):
    def answers(job):
        dead = FakeRay.exceptions.RayActorError("killed")
        return dead if job.row == ROWS[0] else finished(job)

    bench = Bench(path, answers)
    bench.driver.run()
    assert bench.states() == [FAILED, *[FINISHED] * 5]
    assert bench.records()[0]["error"] == "its worker is lost: killed"


def test_an_asset_without_memory_is_tried_with_less(path):
    def answers(job):
        none = {"state": NO_MEMORY, "error": "out of memory"}
        return none if job.row == ROWS[0] and not job.saves_memory else finished(job)

    bench = Bench(path, answers)
    noted = []
    write = bench.place.write

    def watched(files):
        noted.extend(json.loads(content) for content in files.values())
        write(files)

    bench.place.write = watched
    bench.driver.run()
    assert bench.states() == [FINISHED] * 6 and len(bench.ray.restarted) == 1
    (failed,) = (record for record in noted if "error" in record)  # for a driver that is killed
    assert failed["saves_memory"] is True and "low.yaml" in failed["command"]
    tries = [job.saves_memory for job in bench.worker.made if job.row == ROWS[0]]
    assert tries == [False, True]


@pytest.mark.parametrize("low_memory", [LOW, None])
def test_an_asset_without_memory_is_reported_at_last(path, low_memory):
    def answers(job):
        none = {"state": NO_MEMORY, "error": "out of memory"}
        return none if job.row == ROWS[0] else finished(job)

    bench = Bench(path, answers, low_memory=low_memory)
    bench.driver.run()
    assert bench.states() == [FAILED, *[FINISHED] * 5]
    assert ("low.yaml" in bench.records()[0]["command"]) == bool(low_memory)


def test_a_full_disk_ends_the_farm_and_leaves_the_assets_to_the_next(path):
    def answers(job):
        full = {"state": BLOCKED, "error": "No space left"}
        return full if job.row == ROWS[2] else finished(job)

    bench = Bench(path, answers)
    with pytest.raises(UserError, match="No space left"):
        bench.driver.run()
    assert bench.states() == [FINISHED, FINISHED, STOPPED, *[WAITING] * 3] and bench.stops


def test_assets_that_all_fail_alike_end_the_farm(path):
    bench = Bench(path, lambda job: {"state": FAILED, "error": "no model"})
    with pytest.raises(UserError, match="first 3 assets have failed alike.*no model"):
        bench.driver.run()
    assert len(bench.worker.made) == 3


def test_assets_that_fail_differently_do_not(path):
    bench = Bench(path, lambda job: {"state": FAILED, "error": job.row.name})
    bench.driver.run()
    assert bench.states() == [FAILED] * 6


def test_a_worker_that_hangs_is_restarted_once_for_each_standstill(path):
    bench = Bench(path, finished, rows=ROWS[:1])
    bench.driver.fill()
    for beat, seconds, restarts in (
        (Beat("toy0", 1, "training", 3, 9), 9.0, 0),
        (Beat("toy0", 1, "training", 3, 9), 11.0, 1),
        (Beat("toy0", 1, "training", 3, 9), 12.0, 1),
        (Beat("toy0", 2, "starting", 0, 0), 1.0, 1),
        (Beat("toy0", 2, "starting", 0, 0), 11.0, 2),
        (Beat("earlier", 1, "rendering", 1, 0), 99.0, 2),
    ):
        bench.driver.restart_hung({0: (beat, seconds)})
        assert len(bench.ray.restarted) == restarts, beat


def test_an_asset_whose_worker_was_told_to_stop_is_handed_out_again(path):
    """As when its machine is drained."""

    def answers(job):
        if job.row == ROWS[0] and not bench.states()[0] == STOPPED:
            return {"state": STOPPED, "error": "stopped by signal 15"}
        return finished(job)

    bench = Bench(path, answers)
    bench.driver.run()
    assert bench.states() == [FINISHED] * 6 and not bench.stops
    again = [job for job in bench.worker.made if job.row == ROWS[0]]
    assert len(again) == 2 and again[1].spent >= 100


def test_a_row_that_was_given_an_option_of_the_farm_later_fails_alone(path):
    def answers(job):
        failed = {"state": FAILED, "error": "resume is set by the farm"}
        return failed if job.row.overrides else finished(job)

    bench = Bench(path, answers, rows=[ROWS[0]._replace(overrides=("resume=a",)), *ROWS[1:]])
    bench.driver.run()
    assert bench.driver.counts == {FAILED: 1, FINISHED: 5}


def test_a_refused_row_leaves_no_record_beside_what_the_other_has_made(path):
    def answers(job):
        refused = {"state": REFUSED, "error": "was begun with another prompt"}
        return refused if job.row == ROWS[0] else finished(job)

    bench = Bench(path, answers)
    bench.driver.run()
    assert bench.states() == [WAITING, *[FINISHED] * 5] and bench.driver.counts[FAILED] == 1


def test_ctrl_c_lets_the_workers_write_checkpoints(path):
    def answers(job):
        if job.row == ROWS[1]:
            bench.driver.fill = interrupted
        return finished(job) if job.row == ROWS[0] else {"state": STOPPED, "error": "stopped"}

    def interrupted():
        raise KeyboardInterrupt

    bench = Bench(path, answers)
    with pytest.raises(KeyboardInterrupt):
        bench.driver.run()
    assert bench.stops == 1 and bench.states() == [FINISHED, STOPPED, *[WAITING] * 4]


def test_a_record_that_can_not_be_written_ends_the_farm_and_not_ctrl_c(path, monkeypatch):
    bench = Bench(path, lambda job: {"state": FAILED, "error": "x"})

    def full(folder, *args, **options):
        raise OSError(errno.ENOSPC, "no space left")

    monkeypatch.setattr("pathlib.Path.mkdir", full)
    with pytest.raises(UserError, match="no space left"):
        bench.driver.run()
    assert len(bench.worker.made) == 1 and bench.stops
