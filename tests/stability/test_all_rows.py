"""Every row has a test, and the table has every row of the list that it was written from."""

import ast
import json
import re
from pathlib import Path

import pytest

from tests.stability.faults import FAULTS
from tests.stability.report import RESULTS
from tests.stability.rows import OTHERS, ROWS

FOLDER = Path(__file__).parent


def rows_with_a_test() -> set[tuple[str, str]]:
    """Return (group, name) of every ``@row(group, name)`` in this folder."""
    trees = [ast.parse(path.read_text()) for path in FOLDER.glob("test_*.py")]
    calls = [
        node
        for tree in trees
        for node in ast.walk(tree)
        if isinstance(node, ast.Call) and getattr(node.func, "id", "") == "row"
    ]
    return {tuple(ast.literal_eval(argument) for argument in call.args) for call in calls}


NOT_YET: set[str] = set()
"""Groups whose rows have no test in this folder yet; the report names them as not run."""


def test_every_row_has_a_test():
    missing = set(ROWS) - rows_with_a_test()
    assert {group for group, _ in missing} == NOT_YET, sorted(missing)


def test_every_result_names_a_row_and_tests_that_exist():
    for entry in json.loads(RESULTS.read_text()):
        assert (entry["group"], entry["name"]) in ROWS
        for file, _, name in (test.partition("::") for test in entry["tests"]):
            assert f"def {name}(" in (FOLDER / f"{file}.py").read_text(), f"{file}::{name}"


def test_the_table_is_complete(shared_folder):
    """Compare with the list of known failures, if it is available."""
    path = shared_folder / "reference" / "stability.md"
    if not path.exists():
        pytest.skip("the list of known failures isn't here")
    text = path.read_text()
    assert {name for name, *_ in FAULTS} == set(re.findall(r"^\| (F\d+) \|", text, re.M))
    for group, rows in OTHERS.items():
        section = re.search(rf"^## {group}\..*?(?=^#|\Z)", text, re.M | re.S).group()
        names = re.findall(r"^\| ([^|]+?) \|", section, re.M)
        assert {name for name, *_ in rows} == set(names) - {"Failure mode"}
