"""Each part's models are loaded and timed; the committed times are within the bound."""

import csv
import sys

import pytest

from benchmarks.markdown import read
from benchmarks.models import loading

SECONDS = 2.0
"""CPU seconds in which the models are loaded, after the libraries are imported."""


def test_each_part_is_loaded_and_timed(monkeypatch, tmp_path):
    pytest.importorskip("diffusers")
    monkeypatch.setattr(loading, "RESULTS", tmp_path / "loading.csv")
    monkeypatch.setattr(sys, "argv", ["loading", "--rounds", "1"])
    loading.main()
    rows = list(csv.DictReader(open(tmp_path / "loading.csv")))
    assert [row["part"] for row in rows] == list(loading.LOADERS)
    assert all(float(row["cpu_seconds"]) > 0 for row in rows)
    assert len(loading.table().splitlines()) == 9


def test_the_measured_times_are_within_the_bound():
    assert sum(float(row["cpu_seconds"]) for row in read(loading.RESULTS)) < SECONDS
