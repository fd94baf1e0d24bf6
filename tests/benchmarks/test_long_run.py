"""The long run with kills, short: benchmarks/robustness/long_run.py does 20,000 steps and 50
kills.
"""

import json

import pytest

from benchmarks.robustness import long_run
from benchmarks.robustness.supervisor import Life, Sample


@pytest.mark.slow
def test_a_run_that_is_killed_ends_as_if_it_had_not_been(tmp_path, capsys):
    code = long_run.main(
        [
            "--steps",
            "160",
            "--kills",
            "2",
            "--every",
            "20",
            "--minutes",
            "8",
            "--out",
            str(tmp_path / "out.json"),
        ]
    )
    result = json.loads((tmp_path / "out.json").read_text())
    assert code == 0 and result["holds"], capsys.readouterr().out
    assert result["kills"] == 2 and result["final_step"] == 160 and result["same_final_state"]
    assert result["written_steps_lost"] == result["half_written_files"] == 0


def test_steps_that_were_written_and_done_again_are_counted():
    lives = [
        Life(3, True, 0, 40),
        Life(3, True, 40, 40),
        Life(3, True, 20, 60),
        Life(9, False, 60, 100),
    ]
    assert long_run.lost_steps(lives) == 20  # the third went on from 20, though 40 had been written
    assert long_run.lost_steps(lives[:2]) == 0


def test_memory_that_grows_is_seen():
    samples = [
        Sample(t / 2, 10 * t, 500.0 + 0.03 * t + t % 2) for t in range(200)
    ]  # 3 MB per 1000 steps, and a ripple
    slope = long_run.memory_slope(samples, 2000)
    assert abs(slope["mb_per_1000_steps"] - 3) < 0.1 and slope["standard_error"] < 0.2


def test_lives_are_long_enough_to_get_on():
    """The mean progress of many lives is what they are to leave behind, also where most of them end
    while starting.
    """
    for startup, gain in ((5.0, 1.5), (5.0, 0.1), (1.0, 10.0)):
        longest = long_run.longest_life(startup, gain)
        progress = [max(0.0, longest * (i + 0.5) / 1000 - startup) for i in range(1000)]
        assert abs(sum(progress) / 1000 - gain) < 0.01


def test_start_up_and_speed_are_told_from_what_is_written():
    samples = [
        Sample(t / 10, max(0, t - 50), 1.0) for t in range(150)
    ]  # 10 steps per second after 5 seconds
    startup, rate = long_run.startup_seconds(samples, 1)
    assert abs(startup - 5) < 0.2 and abs(rate - 10) < 0.2
