"""Reports of workers, and how the farm's stop reaches them."""

from types import SimpleNamespace

from threestudio_gaussiandreamer.farm import worker
from threestudio_gaussiandreamer.farm.board import Beat, Board
from threestudio_gaussiandreamer.farm.recipe import Job
from threestudio_gaussiandreamer.farm.rows import Row
from threestudio_gaussiandreamer.farm.worker import Heartbeat

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
    told, stops, steps = [], [], []
    monkeypatch.setattr(worker.signal, "raise_signal", stops.append)
    monkeypatch.setattr(Heartbeat, "report", lambda _, beat: told.append(beat) or len(told) > 2)
    setting = SimpleNamespace(
        place=SimpleNamespace(keep_checkpoint=lambda *asset: steps.append(asset))
    )
    beats = Heartbeat(Job(Row("fox", "a fox")), 1, 0, setting)
    for _ in range(4):
        now.seconds += 0.5
        beats.on_train_batch_end(SimpleNamespace(global_step=3, max_steps=12))
    assert [beat.stage for beat in told] == ["starting", "training", "training"]
    now.seconds = 9.0
    beats.on_train_batch_end(SimpleNamespace(global_step=4, max_steps=12))
    assert told[-1] == BEAT._replace(step=4) and len(steps) == 5
    assert stops == [worker.signal.SIGTERM]
