"""The benchmark of the checks runs from end to end, at a tiny size."""

import csv

from benchmarks.robustness import bench_guards


def test_every_guard_is_timed(tmp_path, monkeypatch):
    monkeypatch.setattr(bench_guards, "RESULTS", tmp_path / "guards.csv")
    sizes = ["--gaussians", "20", "--size", "16", "--views", "1"]
    monkeypatch.setattr("sys.argv", ["", *sizes, "--threads", "1", "--seconds", "0.01"])
    bench_guards.main()
    with (tmp_path / "guards.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 8 and all(float(row["guard_ms"]) > 0 for row in rows)
