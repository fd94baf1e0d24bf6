"""Reports of workers, and how the farm's stop reaches them."""

from types import SimpleNamespace

from threestudio_gaussiandreamer.farm import board
from threestudio_gaussiandreamer.farm.board import Beat, Board, Heartbeat

BEAT = Beat("fox", 1, "training", 3, 12)


def test_the_board_knows_since_when_nothing_has_changed(monkeypatch):
    now = SimpleNamespace(seconds=0.0)
    monkeypatch.setattr(board.time, "monotonic", lambda: now.seconds)
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
    monkeypatch.setattr(board.time, "monotonic", lambda: now.seconds)
    told, stops, steps = [], [], []
    report = lambda beat: told.append(beat) or len(told) > 2  # noqa: E731
    beats = Heartbeat("fox", 1, report, lambda: stops.append(1), lambda: steps.append(1))
    for _ in range(4):
        now.seconds += 0.5
        beats.on_train_batch_end(SimpleNamespace(global_step=3, max_steps=12))
    assert [beat.stage for beat in told] == ["starting", "training", "training"]
    now.seconds = 9.0
    beats.on_train_batch_end(SimpleNamespace(global_step=4, max_steps=12))
    assert told[-1] == BEAT._replace(step=4) and len(stops) == 1 and len(steps) == 5
