"""Milliseconds of a run's imports by package, and their table."""

import pytest

from benchmarks.markdown import write_rows
from benchmarks.start import import_times, tables

PRINTED = """
import time: self [us] | cumulative | imported package
import time:      1000 |       1000 |       _socket
import time:      2000 |       3000 |     numpy.core
import time:      4000 |       7000 |   numpy
import time:      8000 |       8000 |     torch.nn
import time:     10000 |      25000 | torch
the cloud starts with 5 Gaussians
import time:       500 |        500 | torch.late
"""


def test_times_are_added_by_package_and_imports_within_one_count_once():
    times = import_times.by_package(PRINTED.splitlines())
    assert times == {
        "torch": (18.5, 25.5),
        "numpy": (6.0, 7.0),
        import_times.STANDARD: (1.0, 1.0),
    }


def test_the_table_has_the_largest_packages_first_and_their_shares(monkeypatch, tmp_path):
    monkeypatch.setattr(tables, "FOLDER", tmp_path)
    own = {"small": (0.5, 0.5), "numpy": (19.5, 20.0), "torch": (80.0, 100.0)}
    rows = [("abc1234", "a processor", 0, name, *both) for name, both in own.items()]
    write_rows(tmp_path / "imports.csv", import_times.COLUMNS, rows)
    head, _, *lines, _, processor = tables.imports().splitlines()
    assert "abc1234" in head and processor == "Processor: a processor."
    assert lines == [
        "| `torch` | 80 (80 %) | 100 (100 %) |",
        "| `numpy` | 20 (20 %) | 20 (20 %) |",
        "| 1 others | 0 (0 %) |  |",
        "| all | 100 |  |",
    ]


@pytest.mark.parametrize("module", ["_io", "os.path", "encodings.utf_8"])
def test_the_standard_library_is_one_package(module):
    assert import_times.package_of(module) == import_times.STANDARD
