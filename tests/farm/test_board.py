"""Reports of workers, and how the farm's stop reaches them."""

from types import SimpleNamespace

from threestudio_gaussiandreamer.farm import board
from threestudio_gaussiandreamer.farm.board import Beat, Board, Reporter
from threestudio_gaussiandreamer.farm.display import Display, duration, worker_line
from threestudio_gaussiandreamer.farm.heartbeat import Heartbeat

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


def test_reports_are_rare_and_their_answers_are_not_waited_for(monkeypatch):
    now = SimpleNamespace(seconds=0.0)
    monkeypatch.setattr(board.time, "monotonic", lambda: now.seconds)
    sent, answers = [], iter([None, True, False])
    reporter = Reporter(lambda beat: sent.append(beat) or len(sent), lambda handle: next(answers))
    assert [reporter(BEAT) for _ in range(9)] == [False] * 9 and len(sent) == 1
    now.seconds = 1.0
    assert not reporter(BEAT) and len(sent) == 2  # the first answer hasn't come
    assert reporter(BEAT, now=True) and len(sent) == 3
    now.seconds = 2.0
    assert reporter(BEAT) and reporter(BEAT)


def test_a_run_is_stopped_once():
    stops, steps = [], []
    beats = Heartbeat("fox", 1, lambda beat: True, lambda: stops.append(1), lambda: steps.append(1))
    trainer = SimpleNamespace(global_step=3, max_steps=12)
    beats.on_train_batch_end(trainer)
    beats.on_train_batch_end(trainer)
    assert len(stops) == 1 and len(steps) == 2


def test_the_line_of_a_worker_says_what_it_does():
    line = worker_line(1, "fox", (BEAT, 0.0))
    assert "######.................." in line and "training 3/12" in line and line.endswith("fox")
    assert "2 min 05 s without a step" in worker_line(1, "fox", (BEAT, 125.0))
    assert "waiting for a process" in worker_line(1, "cat", (BEAT, 0.0))


def test_durations_and_the_estimate(monkeypatch):
    assert [duration(s) for s in (5, 65, 3720)] == ["5 s", "1 min 05 s", "1 h 02 min"]
    display = Display(total=10, done=2, stream=open("/dev/null", "w"))
    display.began -= 60
    assert "left" not in display.total_line()
    display.note("fox", "finished", "")
    assert display.total_line() == "3 of 10 finished, 1 min 00 s, about 7 min 00 s left"
