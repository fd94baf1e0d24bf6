import json
import re
from pathlib import Path

from tests.stability.report import RESULTS, ROWS

TESTS = {path.stem: path.read_text() for path in Path(__file__).parent.glob("test_*.py")}


def test_every_row_has_a_test_and_every_result_a_row_and_tests_that_exist():
    marks = re.findall(r'^@row\(\s*"(A\d)",\s*"(.+?)"[,)]', "".join(TESTS.values()), re.MULTILINE)
    assert len(ROWS) == 90 and set(marks) == set(ROWS)
    for entry in json.loads(RESULTS.read_text()):
        assert (entry["group"], entry["name"]) in ROWS
        for file, _, name in (test.partition("::") for test in entry["tests"]):
            assert f"def {name}(" in TESTS[file], f"{file}::{name}"
