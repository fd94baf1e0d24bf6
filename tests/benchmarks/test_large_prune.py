"""The measurement of pruning a large cloud, without pruning."""

import pytest

from benchmarks.markdown import read, write
from benchmarks.quality import large_prune
from benchmarks.quality.runs import ROOT

FOUND = {"seconds": 9.5, "cpu_seconds": 15.0, "peak_gb": 1.5, "left": 70, "psnr": 40.5}


def run(monkeypatch, *arguments):
    monkeypatch.setattr("sys.argv", ["", "--gaussians", "100", "--size", "32", *arguments])
    large_prune.main()


def test_the_budget_is_passed_on_and_noted(tmp_path, monkeypatch):
    asked = []

    def prune(checkout, folder, options):
        assert (folder / "in.ply").is_file()
        asked.append(options)
        return FOUND

    monkeypatch.setattr(large_prune, "RESULTS", tmp_path / "large_prune.csv")
    monkeypatch.setattr(large_prune, "prune", prune)
    monkeypatch.setattr(large_prune, "require_kernel", lambda: None)
    run(monkeypatch, "--psnr", "40")
    run(monkeypatch)
    assert asked == [["--psnr", "40", "--size", "32"], ["--count", "100000", "--size", "32"]]
    rows = read(large_prune.RESULTS)
    assert [row["budget"] for row in rows] == ["--psnr 40", "--count 100000"]
    assert all(row["machine"] and int(row["cores"]) > 0 and row["left"] == "70" for row in rows)


def test_two_checkouts_of_one_commit_are_not_compared(monkeypatch, capsys):
    with pytest.raises(SystemExit):
        run(monkeypatch, "--against", str(ROOT))
    assert "of the same commit" in capsys.readouterr().err


def test_the_aim_is_that_of_two_cores(tmp_path, monkeypatch):
    monkeypatch.setattr(large_prune, "RESULTS", tmp_path / "large_prune.csv")
    place = {"machine": "a processor", "commit": "abc", "gaussians": 2_000_000}
    cases = (("2", 300, 4), ("2", 301, 1), ("2", 10, 4.1), ("4", 10, 1), ("", 10, 1))
    rows = [
        place | FOUND | {"budget": "--psnr 40", "cores": n, "seconds": seconds, "peak_gb": memory}
        for n, seconds, memory in cases
    ]
    write(large_prune.RESULTS, large_prune.COLUMNS, rows)
    head, _, *lines = large_prune.table().splitlines()
    assert head.endswith("| within 300 s and 4 GB on 2 cores |")
    assert [line.split(" | ")[-1] for line in lines] == [
        f"{found} |" for found in ("yes", "no", "no", "not measured", "not measured")
    ]
    assert (
        "| a processor |" in lines[-1]
        and "| a processor, 4 cores |" in lines[3]
        and "| 40.5 |" in lines[0]
    )
