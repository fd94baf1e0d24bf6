"""Sizes that don't fit into memory are rejected before any work."""

import pytest

from threestudio_gaussiandreamer.core import memory, options
from threestudio_gaussiandreamer.core.errors import UserError


def test_what_is_larger_than_the_memory_is_refused(monkeypatch):
    monkeypatch.setattr(memory, "memory_bytes", lambda: 1000)
    memory.require_memory("size", 1000, "pictures")
    with pytest.raises(UserError, match="^size: pictures take about 2 kB of memory, .* 1 kB"):
        memory.require_memory("size", 2000, "pictures")


def test_a_count_is_a_whole_number_that_the_memory_holds(monkeypatch):
    monkeypatch.setattr(memory, "memory_bytes", lambda: 1000)
    rule = memory.count_of("points", 1, bytes_each=100)[options.RULE]
    rule("n", 10)
    for wrong, message in ((11, "n: 11 points take"), (0, "n: expected 1 or more points, got 0")):
        with pytest.raises(UserError, match=message):
            rule("n", wrong)


def test_the_memory_of_a_container_counts(monkeypatch, tmp_path):
    whole = memory.main_memory()
    assert whole > 2**28
    (tmp_path / "limit").write_text("123456\n")
    monkeypatch.setattr(memory, "CGROUP_LIMIT", tmp_path / "limit")
    assert memory.main_memory() == 123456
    (tmp_path / "limit").write_text("max\n")
    assert memory.main_memory() >= whole
