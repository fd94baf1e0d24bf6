"""The report: tables, gallery and failures."""

import csv

import pytest

from threestudio_gaussiandreamer.farm import report
from threestudio_gaussiandreamer.farm.place import FAILED, FINISHED, RUNNING, WAITING, Place
from threestudio_gaussiandreamer.farm.rows import Row

ROWS = [Row(f"toy{i}", f"a <b>toy</b> {i}", i) for i in range(5)]


@pytest.fixture
def place(tmp_path):
    place = Place(tmp_path)

    def note(number, file, **record):
        row = ROWS[number]
        place.write(f"assets/{row.name}/{file}", {"key": row.key, **record})

    done = {"seconds": 36.0, "worker_seconds": 72.0, "steps": 5, "saves_memory": False}
    scores = {"scores": {"psnr": 30.0}, "picture": "save/it5-test/0.png", "page": "a.html"}
    note(0, "result.json", **done, **scores)
    place.work_folder(ROWS[1]).mkdir()
    failed = {"error": "no <space>", "command": "launch 'a b'", "worker_seconds": 108.0}
    note(2, "failed.json", **failed)
    note(3, "result.json", **done)
    return place


def test_the_report_has_states_costs_pictures_and_failures(tmp_path, place, monkeypatch):
    """With the cost of all attempts and of failures; texts are escaped."""
    monkeypatch.setattr(report, "PER_PAGE", 1)
    monkeypatch.setattr(report, "BATCH", 2)
    path, _ = report.write_report(place, ROWS, len(ROWS), price=100.0)
    with open(tmp_path / "report/table.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    states = [row["state"] for row in rows]
    assert states == [FINISHED, RUNNING, FAILED, FINISHED, WAITING]
    assert [row["cost"] for row in rows] == ["2.0", "", "3.0", "2.0", ""]
    assert (rows[0]["psnr"], rows[0]["seed"], rows[2]["command"]) == ("30.0", "0", "launch 'a b'")
    first = path.read_text()
    assert "<td>04:12</td>" in first and "7, 3.5 per finished asset" in first
    assert "no &lt;space&gt;" in first and "launch &#39;a b&#39;" in first
    assert "page-2.html" in first and "page-3.html" not in first
    page = (tmp_path / "report/page-1.html").read_text()
    assert 'src="../assets/toy0/save/it5-test/0.png"' in page and "a &lt;b&gt;toy" in page
    assert 'href="../assets/toy0/a.html"' in page and (tmp_path / "report/page-2.html").exists()
    parquet = pytest.importorskip("pyarrow.parquet")
    rows = parquet.read_table(tmp_path / "report/table.parquet").to_pylist()
    assert [row["name"] for row in rows] == [row.name for row in ROWS]
    assert rows[0]["seconds"] == 36.0 and rows[4]["seconds"] is None
    assert list(rows[0]) == list(report.COLUMNS)
