import json

import pytest

from benchmarks.start.demo_stages import stages_of_demo
from benchmarks.start.launched import MARK


def test_the_stages_of_several_runs_are_added_up_to_the_whole_demo():
    # processor seconds of each process, and the time of day
    first = {"import": (2.0, 103.0), "training": (7.0, 110.0)}
    second = {"import": (3.0, 112.0), "training": (9.0, 121.0)}
    output = "".join(f"other\n{MARK}{json.dumps(run)}\n" for run in (first, second))
    found = list(stages_of_demo(output, 100.0, ("demo", 25.0, 20.0)))
    expected = [("import", 5.0, 5.0), ("training", 16.0, 11.0), ("after the runs", 4.0, 4.0)]
    assert [row[0] for row in found] == [row[0] for row in expected]
    for row, other in zip(found, expected, strict=True):
        assert row[1:] == pytest.approx(other[1:])
    assert sum(row[1] for row in found) == pytest.approx(25)
    assert sum(row[2] for row in found) == pytest.approx(20)
