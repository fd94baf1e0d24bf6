"""Typed configurations of parts."""

from dataclasses import dataclass, field
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from omegaconf import OmegaConf

from threestudio_gaussiandreamer.core.errors import UserError
from threestudio_gaussiandreamer.core.interpolation import escape
from threestudio_gaussiandreamer.host.builtin.base import (
    parse_structured,
)


@dataclass
class Options:
    size: int = 3
    text: str = ""
    rates: Any = 0.1
    inner: dict = field(default_factory=dict)


def test_values_are_typed_and_defaults_filled():
    cfg = parse_structured(Options, {"size": "5", "rates": [1, 2, 3]})
    assert cfg.size == 5 and list(cfg.rates) == [1, 2, 3] and cfg.text == ""
    assert parse_structured(Options).size == 3


def test_equal_values_give_configurations_of_their_own():
    first = parse_structured(Options, {"inner": {"a": 1}})
    first.inner.a = first.size = 2
    second = parse_structured(Options, {"inner": {"a": 1}})
    assert second.inner.a == 1 and second.size == 3
    assert parse_structured(Options, {"text": "1"}) != parse_structured(Options, {"rates": 1})


def test_a_value_that_refers_to_another_section_is_read_each_time():
    for size in (4, 5):
        whole = OmegaConf.create({"pixels": size, "part": {"size": "${pixels}"}})
        assert parse_structured(Options, whole.part).size == size


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"szie": 3}, "unknown key 'szie': did you mean 'size'"),
        ({"size": "big"}, "size: expected a whole number, got 'big'"),
        ({"inner": 3}, "inner"),
        ("size", "expected keys and values"),
    ],
)
def test_a_mistake_in_a_configuration_is_named(values, message):
    with pytest.raises(UserError, match=message):
        parse_structured(Options, values)


@given(st.text(alphabet="ab\\${} :#[]", max_size=12))
def test_strings_stay_text_even_if_they_look_like_numbers(text):
    assert OmegaConf.create({"x": escape(text)}).x == text
    cfg = parse_structured(Options, {"text": text, "inner": {"prompt": text}})
    assert cfg.text == text and cfg.inner.prompt == text
    # a part hands a section of its own configuration on
    assert (
        parse_structured(Options, {"text": cfg.inner.prompt, "inner": cfg.inner}).inner.prompt
        == text
    )
