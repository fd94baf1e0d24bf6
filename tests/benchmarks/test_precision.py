"""The networks are measured in each precision and memory format, and compared with float32."""

import csv
import sys

import pytest

from benchmarks.models import precision


def test_each_setting_is_measured_and_compared(monkeypatch, tmp_path):
    pytest.importorskip("diffusers")
    monkeypatch.setattr(precision, "VIEWS", 1)  # bfloat16 is slow where the CPU doesn't multiply it
    monkeypatch.setattr(precision, "RESULTS", tmp_path / "precision.csv")
    monkeypatch.setattr(sys, "argv", ["precision", "--rounds", "1"])
    precision.main()
    rows = list(csv.DictReader(open(tmp_path / "precision.csv")))
    assert len(rows) == 8 and all(float(row["cpu_ms"]) > 0 for row in rows)
    errors = {(r["network"], r["format"], r["precision"]): float(r["error"]) for r in rows}
    for network in {row["network"] for row in rows}:
        assert errors[network, "contiguous", "float32"] == 0
        assert errors[network, "channels last", "float32"] < 1e-4
        assert 1e-4 < errors[network, "contiguous", "bfloat16"] < 0.1
    assert len(precision.table().splitlines()) == 10
