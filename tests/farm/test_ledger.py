"""The ledger: the last line counts, half lines are skipped, and a large one is read quickly."""

import errno
import os

import pytest

from threestudio_gaussiandreamer.core.errors import UserError
from threestudio_gaussiandreamer.farm.ledger import FAILED, FINISHED, RUNNING, Ledger
from threestudio_gaussiandreamer.farm.rows import Row

FOX, CAT = Row("fox", "a fox"), Row("cat", "a cat")


def line(row, state, **more):
    return {"name": row.name, "key": row.key, "state": state, **more}


@pytest.fixture
def path(tmp_path):
    return tmp_path / "ledger.jsonl"


def test_the_last_line_of_an_asset_counts(path):
    ledger = Ledger(path)
    assert ledger.state(FOX) is None and ledger.last(FOX) is None
    ledger.append([line(FOX, RUNNING), line(CAT, RUNNING)])
    ledger.append([line(FOX, FINISHED, hash="ab", loss=float("nan"))])
    for known in (ledger, Ledger(path)):
        assert known.state(FOX) == FINISHED and known.state(CAT) == RUNNING
        assert known.last(FOX)["hash"] == "ab" and known.last(FOX)["loss"] is None
    assert ledger.damaged == 0


def test_a_finished_asset_without_files_is_made_again(path):
    nothing = {"files": [], "picture": None, "page": None}
    ledger = Ledger(path)
    ledger.append([line(FOX, FINISHED, **nothing), line(CAT, FINISHED, **nothing | {"page": "a"})])
    assert Ledger(path).state(FOX) == RUNNING and Ledger(path).state(CAT) == FINISHED


@pytest.mark.parametrize("cut", range(1, 40))
def test_half_a_line_is_skipped_and_the_next_one_is_whole(path, cut):
    ledger = Ledger(path)
    ledger.append([line(FOX, FINISHED)])
    whole = path.read_bytes()
    ledger.append([line(CAT, FINISHED)])
    ledger.close()
    os.truncate(path, len(whole) + cut)  # as after a kill in the middle of a write
    again = Ledger(path)
    assert again.state(FOX) == FINISHED and again.state(CAT) is None and again.damaged == 1
    again.append([line(CAT, FAILED)])
    third = Ledger(path)
    assert third.state(CAT) == FAILED and third.state(FOX) == FINISHED
    assert third.last(CAT)["state"] == FAILED and third.damaged == 1


@pytest.mark.parametrize(
    "content",
    [b"\xff\xfe\n", b"[]\n", b"{}\n", b'{"name": 1, "key": "", "state": "running"}\n', b"[" * 9999],
)
def test_lines_of_another_kind_are_counted(path, content):
    path.write_bytes(content + b"\n")
    ledger = Ledger(path)
    assert ledger.index == {} and ledger.damaged >= 1


def test_a_row_that_has_changed_is_refused_with_its_line(path):
    ledger = Ledger(path)
    ledger.append([line(FOX, RUNNING)])
    with pytest.raises(UserError, match="line 7 .*'fox' was begun in this farm with another"):
        ledger.state(FOX._replace(seed=1, line=7))


def test_a_full_disk_is_one_message(path, monkeypatch):
    def full(descriptor):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    ledger = Ledger(path)
    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(UserError, match="can't be written: No space left on device; make room"):
        ledger.append([line(FOX, RUNNING)])


def test_a_large_ledger_keeps_little_in_memory(path):
    import tracemalloc

    ledger = Ledger(path)
    ledger.append(line(Row(f"asset{i}", "a"), RUNNING, text="x" * 500) for i in range(2000))
    tracemalloc.start()
    again = Ledger(path)
    held, _ = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert len(again.index) == 2000 and held < 2000 * 500
