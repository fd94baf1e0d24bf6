"""Shares of a training step: which rows are kept, what the probe measures, and the table."""

import csv
import sys

import pytest

from benchmarks.markdown import write_rows
from benchmarks.start import step_shares, tables
from benchmarks.start.launched import ROOT, run_with_probe
from tests.training.runs import SMALL
from threestudio_gaussiandreamer.splatting.cpu import backend as cpu


def measure(monkeypatch, *workloads):
    monkeypatch.setattr(sys, "argv", ["", "--rounds", "1", "--workloads", *workloads])
    step_shares.main()


def test_rows_of_other_workloads_stay_but_not_of_those_that_no_longer_exist(monkeypatch, tmp_path):
    monkeypatch.setattr(step_shares, "RESULTS", tmp_path / "step.csv")
    times = iter((1.0, 2.0, 3.0, 4.0, 5.0))
    monkeypatch.setattr(
        step_shares, "milliseconds", lambda *_: {"5–9": {"rasteriser": next(times)}}
    )
    first, second, *_ = step_shares.WORKLOADS
    monkeypatch.setitem(step_shares.WORKLOADS, "former", step_shares.Workload(()))
    measure(monkeypatch, "former")
    monkeypatch.delitem(step_shares.WORKLOADS, "former")
    for workload in (first, second, first):
        measure(monkeypatch, workload)
    rows = list(csv.DictReader(open(tmp_path / "step.csv")))
    assert [(row["workload"], row["cpu_ms"]) for row in rows] == [
        (first, "4.000"),
        (second, "3.000"),
    ]
    assert all(row["commit"] and row["machine"] and row["steps"] == "5–9" for row in rows)


@pytest.mark.slow
@pytest.mark.skipif(cpu.unavailable() is not None, reason=str(cpu.unavailable()))
@pytest.mark.parametrize("guidance", ["exact-score-guidance", "empty-networks-guidance"])
def test_the_probe_finds_the_network_in_the_score(guidance):
    windows = {"STEP_WINDOWS": "1 3 4 6"}
    options = [*SMALL, f"system.guidance_type={guidance}", "trainer.limit_val_batches=0"]
    found = run_with_probe(step_shares.PROBE, ROOT, *options, environment=windows)["windows"]
    assert len(found) == 2 and {*tables.NOT_THE_REST, tables.LOGS} < found[0].keys()
    for seconds in found:
        assert all(value > 0 for value in seconds.values()), seconds


PARTS = {
    "rasteriser": 50.0, "network": 10.0, "optimiser": 10.0, "rest of the score": 20.0,
    "logs and progress bar": 2.0, "loop and the rest": 8.0,
}  # fmt: skip


def test_only_rasteriser_network_and_optimiser_are_left_out_of_the_rest(monkeypatch, tmp_path):
    monkeypatch.setattr(tables, "FOLDER", tmp_path)
    rows = []
    for steps, network in (("50–100", 10.0), ("350–400", 60.0)):
        for part, ms in (PARTS | {"network": network}).items():
            rows.append(("demo", steps, "now", "abc1234", "a processor", 0, part, ms))
    write_rows(tmp_path / "step.csv", step_shares.COLUMNS, rows)
    head, _, *lines, _, processor = tables.step_parts().splitlines()
    assert "| demo, steps 50–100, now (abc1234) | demo, steps 350–400, now (abc1234) |" in head
    assert processor == "Processor: a processor."
    cells = {line.split(" | ")[0].strip("| "): line.rstrip(" |").split(" | ")[1:] for line in lines}
    assert cells["rest of the score"] == ["20.0 (20.0 %)", "20.0 (13.3 %)"]
    assert cells[f"{tables.LOGS}, at most 2 %"] == ["2.0 (2.0 %): met", "2.0 (1.3 %): met"]
    assert cells[f"{tables.REST}, at most 25 %"] == ["30.0 (30.0 %): missed", "30.0 (20.0 %): met"]
    assert cells["all"] == ["100.0", "150.0"]
