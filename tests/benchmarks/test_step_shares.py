"""A measurement of some workloads leaves the rows of the others."""

import csv
import sys

from benchmarks.start import step_shares


def test_rows_of_other_workloads_stay(monkeypatch, tmp_path):
    monkeypatch.setattr(step_shares, "RESULTS", tmp_path / "step.csv")
    times = iter((1.0, 2.0, 3.0, 4.0))
    monkeypatch.setattr(step_shares, "milliseconds", lambda *_: {"score": next(times)})
    first, second, *_ = step_shares.WORKLOADS
    for workload in (first, second, first):
        monkeypatch.setattr(sys, "argv", ["", "--rounds", "1", "--workloads", workload])
        step_shares.main()
    rows = list(csv.DictReader(open(tmp_path / "step.csv")))
    assert [(row["workload"], row["cpu_ms"]) for row in rows] == [
        (second, "2.000"),
        (first, "3.000"),
    ]
