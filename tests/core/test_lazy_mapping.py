"""Values of a lazy mapping are computed once, and only if they are read."""

import pytest

from threestudio_gaussiandreamer.core.lazy_mapping import LazyMapping


def test_values_are_computed_once_when_they_are_read():
    calls = []
    mapping = LazyMapping({"a": 1}, {"b": lambda: calls.append("b") or 2, "c": lambda: 1 / 0})
    assert "b" in mapping and "c" in mapping and "d" not in mapping
    assert list(mapping) == ["a", "b", "c"] and len(mapping) == 3 and not calls
    assert mapping["b"] == mapping.get("b") == 2 and calls == ["b"]
    assert len(mapping) == 3 and mapping.get("d", 5) == 5
    with pytest.raises(KeyError):
        mapping["d"]


def test_it_can_be_copied_and_changed_like_a_dict():
    mapping = LazyMapping({"a": 1}, {"b": lambda: mapping["a"] + 1, "c": lambda: 1 / 0})
    mapping["c"] = 3
    assert {**mapping} == dict(mapping) == mapping == {"a": 1, "b": 2, "c": 3}
