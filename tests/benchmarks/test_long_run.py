"""A short version of benchmarks/robustness/long_run.py, and its arithmetic."""

import json

import pytest

from benchmarks.robustness import long_run
from benchmarks.robustness.supervisor import Sample, Segment


@pytest.mark.slow
def test_a_killed_run_ends_with_the_state_of_an_uninterrupted_one(tmp_path, capsys):
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


def test_checkpointed_steps_that_are_trained_again_are_counted():
    segments = [
        Segment(3, True, 0, 40),
        Segment(3, True, 40, 40),
        Segment(3, True, 20, 60),
        Segment(9, False, 60, 100),
    ]
    assert (
        long_run.lost_steps(segments) == 20
    )  # the third resumed from 20 although 40 had been written
    assert long_run.lost_steps(segments[:2]) == 0


def test_growing_memory_is_measured():
    samples = [
        Sample(t / 2, 10 * t, 500.0 + 0.03 * t + t % 2) for t in range(200)
    ]  # 3 MB per 1000 steps, and a ripple
    slope = long_run.memory_slope(samples, 2000)
    assert abs(slope["mb_per_1000_steps"] - 3) < 0.1 and slope["standard_error"] < 0.2


def test_segments_make_the_intended_progress_on_average():
    """Also if most processes are killed during startup."""
    for startup, gain in ((5.0, 1.5), (5.0, 0.1), (1.0, 10.0)):
        longest = long_run.longest_segment(startup, gain)
        progress = [max(0.0, longest * (i + 0.5) / 1000 - startup) for i in range(1000)]
        assert abs(sum(progress) / 1000 - gain) < 0.01


def test_startup_and_speed_follow_from_the_checkpoints():
    samples = [
        Sample(t / 10, max(0, t - 50), 1.0) for t in range(150)
    ]  # 10 steps per second after 5 seconds
    startup, rate = long_run.startup_seconds(samples, 1)
    assert abs(startup - 5) < 0.2 and abs(rate - 10) < 0.2
