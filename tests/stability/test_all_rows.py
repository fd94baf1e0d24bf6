"""Every row has a test."""

import ast
import json
from pathlib import Path

from tests.stability.report import RESULTS
from tests.stability.rows import ROWS

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


def test_every_row_has_a_test():
    assert len(ROWS) == 90 and rows_with_a_test() == set(ROWS)


def test_every_result_names_a_row_and_tests_that_exist():
    for entry in json.loads(RESULTS.read_text()):
        assert (entry["group"], entry["name"]) in ROWS
        for file, _, name in (test.partition("::") for test in entry["tests"]):
            assert f"def {name}(" in (FOLDER / f"{file}.py").read_text(), f"{file}::{name}"
