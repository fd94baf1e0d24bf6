"""A short version of benchmarks/robustness/long_run.py."""

import json

import pytest

from benchmarks.robustness import long_run


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
