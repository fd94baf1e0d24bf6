"""The known failures of ``rows.yaml``, which the stability tests provoke.

Groups: A0 defects in other projects' code, A1 rasteriser, A2 geometry and first cloud, A3
densification, A4 score distillation, A5 runs. ``test_all_rows`` fails if a row has no test.
"""

import difflib
from pathlib import Path
from typing import NamedTuple, Optional

import pytest
import yaml

_TABLE = yaml.safe_load(Path(__file__).with_suffix(".yaml").read_text())


class Row(NamedTuple):
    group: str
    name: str
    bar: str
    peers: str
    title: str = ""
    """One line about the defect (A0), or empty."""


GROUPS = {group: section["title"] for group, section in _TABLE.items()}
ROWS = {
    (group, cells[0]): Row(group, *cells)
    for group, section in _TABLE.items()
    for cells in section["rows"]
}


def row(group: str, name: str, *, bar: Optional[str] = None) -> pytest.MarkDecorator:
    """Mark a test as one of a row; a ``bar`` of its own needs a docstring that justifies it."""
    if (group, name) not in ROWS:
        names = [other for place, other in ROWS if place == group]
        near = difflib.get_close_matches(name, names, n=3, cutoff=0.3)
        raise KeyError(f"group {group} has no row {name!r}; near: {near}")
    return pytest.mark.stability(group, name, bar)
