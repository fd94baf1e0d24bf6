"""The report: tables, gallery and failures, for any number of assets."""

import csv
import json

import pytest

from threestudio_gaussiandreamer.farm import report
from threestudio_gaussiandreamer.farm.place import FAILED, FINISHED, RUNNING, WAITING, Place
from threestudio_gaussiandreamer.farm.rows import Row

ROWS = [Row(f"toy{i}", f"a <b>toy</b> {i}", i) for i in range(5)]


def note(place, row, file, **record):
    place.write({f"assets/{row.name}/{file}": json.dumps({"key": row.key, **record}).encode()})


@pytest.fixture
def place(tmp_path):
    place = Place(tmp_path)
    done = {"seconds": 36.0, "steps": 5, "gaussians": 10, "attempts": 2, "saves_memory": False}
    scores = {"scores": {"psnr": 30.0}, "picture": "save/it5-test/0.png", "page": "a.html"}
    note(place, ROWS[0], "result.json", **done, **scores)
    place.work_folder(ROWS[1]).mkdir()
    note(place, ROWS[2], "failed.json", error="no <space>", command="launch 'a b'")
    note(place, ROWS[3], "result.json", **done)
    return place


def write(place, **options):
    path, states = report.write_report(place, ROWS, len(ROWS), **options)
    return path.read_text()


def read(path):
    with open(path, newline="") as file:
        return list(csv.DictReader(file))


def test_the_table_has_a_row_per_asset_and_its_cost(tmp_path, place):
    write(place, price=2.0)
    rows = read(tmp_path / "report/table.csv")
    states = [row["state"] for row in rows]
    assert states == [FINISHED, RUNNING, FAILED, FINISHED, WAITING]
    assert (rows[0]["cost"], rows[0]["psnr"], rows[0]["seed"]) == ("0.02", "30.0", "0")
    assert rows[1]["cost"] == "" and rows[2]["command"] == "launch 'a b'"


def test_the_cost_has_all_attempts_and_the_failures(tmp_path, place):
    note(place, ROWS[1], "result.json", seconds=36.0, worker_seconds=72.0)
    note(place, ROWS[2], "failed.json", error="none", worker_seconds=108.0)
    first = write(place, price=100.0)
    rows = read(tmp_path / "report/table.csv")
    assert [row["worker_seconds"] for row in rows] == ["36.0", "72.0", "108.0", "36.0", ""]
    assert [row["cost"] for row in rows] == ["1.0", "2.0", "3.0", "1.0", ""]
    assert "<td>04:12</td>" in first and "7, 2.333 per finished asset" in first


def test_parquet_has_the_same_rows(tmp_path, place, monkeypatch):
    parquet = pytest.importorskip("pyarrow.parquet")
    monkeypatch.setattr(report, "BATCH", 2)
    write(place)
    rows = parquet.read_table(tmp_path / "report/table.parquet").to_pylist()
    assert [row["name"] for row in rows] == [row.name for row in ROWS]
    assert rows[0]["seconds"] == 36.0 and rows[4]["seconds"] is None
    assert list(rows[0]) == list(report.COLUMNS)


def test_the_pages_show_pictures_and_failures_escaped(tmp_path, place, monkeypatch):
    monkeypatch.setattr(report, "PER_PAGE", 1)
    first = write(place, price=2.0)
    assert "no &lt;space&gt;" in first and "launch &#39;a b&#39;" in first
    assert "page-2.html" in first and "page-3.html" not in first
    assert "0.04, 0.02 per finished asset" in first
    page = (tmp_path / "report/page-1.html").read_text()
    assert 'src="../assets/toy0/save/it5-test/0.png"' in page and "a &lt;b&gt;toy" in page
    assert 'href="../assets/toy0/a.html"' in page
    assert (tmp_path / "report/page-2.html").exists()


def test_an_empty_farm_has_a_report(tmp_path):
    write(Place(tmp_path))
    assert {row["state"] for row in read(tmp_path / "report/table.csv")} == {WAITING}
