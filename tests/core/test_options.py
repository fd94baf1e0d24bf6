"""Rules declared at the fields of a ``Config``, and the function that checks them."""

import time
from dataclasses import dataclass, field
from enum import Enum
from pathlib import Path
from typing import Any, List, Optional, Tuple

import pytest
from omegaconf import OmegaConf

from threestudio_gaussiandreamer.core import options
from threestudio_gaussiandreamer.core.errors import UserError
from threestudio_gaussiandreamer.core.options import check_options, escape, parse_structured


@dataclass
class Inner:
    start: int = field(default=1, metadata=options.at_least(0, "steps"))
    stop: int = 2

    @staticmethod
    def check(cfg: Any) -> None:
        if cfg.start >= cfg.stop:
            raise UserError(f"stop: expected more than start, got {cfg.stop}")


@dataclass
class Options:
    scale: float = field(default=1.0, metadata=options.positive("world units"))
    share: float = field(default=0.5, metadata=options.between(0, 1))
    degree: int = field(default=0, metadata=options.in_range(0, 3))
    mode: str = field(default="fixed", metadata=options.one_of(("fixed", "random")))
    late: str = field(default="b", metadata=options.one_of(lambda: {"a", "b"}))
    rate: Any = field(default=0.1, metadata=options.schedule(min=0, max=1))
    pair: Tuple[float, float] = field(default=(1.0, 2.0), metadata=options.interval(0, 9))
    color: List[float] = field(
        default_factory=lambda: [0.0], metadata=options.each(options.in_range(0, 1))
    )
    path: str = field(default="x", metadata=options.required("set it to a file"))
    size: Optional[int] = field(default=None, metadata=options.at_least(1))
    free: Any = None
    inner: Inner = field(default_factory=Inner)
    text: str = ""
    table: dict = field(default_factory=lambda: {"on": True, "size": 1.0})
    later: int = 3

    @staticmethod
    def check(cfg: Any) -> None:
        if cfg.size == 13:
            raise UserError("no part may have 13 of anything")


WRONG = [
    ({"scale": 0}, "a.scale: expected a number above 0 (world units), got 0.0"),
    ({"scale": 1e-60}, "a.scale: expected a number above 0"),
    ({"share": 1}, "a.share: expected a number between 0 and 1, got 1.0"),
    ({"degree": 4}, "a.degree: expected a number from 0 to 3, got 4"),
    ({"mode": "fixd"}, "unknown a.mode 'fixd': did you mean 'fixed'?"),
    ({"late": "c"}, "unknown a.late 'c': choose from a, b"),
    ({"rate": [0, 0.5, 2, 9]}, "a.rate: expected values of 1 or less, got 2"),
    ({"rate": -0.1}, "a.rate: expected values of 0 or more, got -0.1"),
    ({"rate": "x"}, "a.rate is 'x'; expected a number, [v0, v1, end]"),
    ({"pair": [2, 1]}, "a.pair: expected [low, high], numbers from 0 to 9 with low <= high"),
    ({"color": [0.5, 2]}, "a.color[1]: expected a number from 0 to 1, got 2.0"),
    ({"path": ""}, "a.path: set it to a file"),
    ({"size": 0}, "a.size: expected 1 or more, got 0"),
    ({"size": 13}, "a: no part may have 13 of anything"),
    ({"free": 10**400}, "a.free: expected a whole number of at most 64 bits"),
    ({"free": {"x": [1, 1e39]}}, "a.free.x[1]: expected a finite number that float32 can hold"),
    ({"inner": {"start": -1}}, "a.inner.start: expected 0 or more (steps), got -1"),
    ({"inner": {"start": 5}}, "a.inner.stop: expected more than start, got 2"),
    ({"szie": 3}, "unknown key 'a.szie': did you mean 'a.size'"),
    ({"inner": {"stpo": 3}}, "unknown key 'a.inner.stpo': did you mean 'a.inner.stop'"),
    ({"inner": 3}, "a.inner is 3; expected keys and values"),
    ({"degree": "big"}, "a.degree: expected a whole number, got 'big'"),
    ({"degree": 2.5}, "a.degree: expected a whole number, got 2.5"),
    ({"degree": True}, "a.degree: expected a whole number, got True"),
    ({"degree": None}, "a.degree: expected a whole number, got null"),
    ({"scale": [1]}, "a.scale: expected a number, got [1]"),
    ({"scale": "nan"}, "a.scale: expected a finite number that float32 can hold, got nan"),
    ({"size": [1]}, "a.size: expected a whole number, got [1]"),
    ({"text": ["a"]}, "a.text: expected a text, got ['a']"),
    ({"text": float("nan")}, "a.text: expected a finite number that float32 can hold, got nan"),
    ({"color": "a"}, "a.color: expected a list, got 'a'"),
    ({"color": [["a"]]}, "a.color[0]: expected a number, got ['a']"),
    ({"pair": [1]}, "a.pair: expected a list of 2, got [1]"),
    ({"pair": [1, float("inf")]}, "a.pair[1]: expected a finite number"),
    ({"table": {"of": 1}}, "unknown key 'a.table.of'"),
]


@pytest.mark.parametrize(("values", "message"), WRONG)
@pytest.mark.parametrize("wrap", [dict, OmegaConf.create], ids=["plain", "omegaconf"])
def test_a_wrong_value_is_named_with_its_path(wrap, values, message):
    with pytest.raises(UserError) as error:
        parse_structured(Options, wrap(values), "a.")
    assert message in str(error.value)


def test_values_become_plain_and_typed_and_the_rest_keeps_its_default():
    limits = {"share": 1e-9, "degree": "3", "rate": [0, 0.0, 1.0, 5], "pair": [3, 3], "size": 1}
    given = {**limits, "scale": 2, "inner": {"stop": 5}, "free": {"a": [1, {"b": 2}]}, "text": 7}
    cfg = parse_structured(Options, OmegaConf.create(given))
    assert (type(cfg), cfg.degree, cfg.pair, cfg.text) == (Options, 3, (3, 3), "7")
    assert type(cfg.scale) is float and type(cfg.free) is dict and type(cfg.free["a"]) is list
    assert (cfg.inner, cfg.later) == (Inner(1, 5), 3)
    assert parse_structured(Options, cfg) == cfg and parse_structured(Options) == Options()
    cfg.free["a"].append(3)
    assert given["free"] == {"a": [1, {"b": 2}]}
    assert parse_structured(Options, {"free": [2**63 - 1, 3.4e38]}).free[0] == 2**63 - 1
    text = "\\\\${a} # :[]"
    assert parse_structured(Options, {"text": text}).text == text
    with pytest.raises(UserError, match="text: expected a text"):
        parse_structured(Options, {"text": "???"})  # what OmegaConf exports for a missing value


class Side(Enum):
    LEFT = 1


@dataclass
class Typed:
    folder: Path = Path()
    side: Optional[Side] = None
    shares: dict[str, float] = field(default_factory=dict)


def test_paths_members_of_enums_and_values_of_dictionaries_are_converted():
    cfg = parse_structured(Typed, {"folder": "a/b", "side": "LEFT", "shares": {"x": "2"}}, "p.")
    assert cfg == Typed(Path("a/b"), Side.LEFT, {"x": 2.0})
    for values, message in ({"side": "LEFY"}, "LEFT"), ({"shares": {"x": "y"}}, "p.shares.x"):
        with pytest.raises(UserError, match=message):
            parse_structured(Typed, values, "p.")


@pytest.mark.parametrize(
    ("raised", "message"),
    [
        (UserError("system.guidance.size is too small"), "^system.guidance.size is too small$"),
        (ValueError("size: too small"), "system.guidance.size: too small"),
    ],
)
def test_a_check_may_give_the_whole_path_or_raise_any_value_error(raised, message):
    @dataclass
    class Config:
        size: int = 1

        @staticmethod
        def check(cfg: Any) -> None:
            raise raised

    with pytest.raises(UserError, match=message):
        check_options(Config, Config(), "system.guidance.")


@pytest.mark.parametrize("text", ["${a}", "\\${a}", "x\\\\${", "\\\\", "${${", "a\\b ${c} \\\\${d"])
def test_escaped_text_is_read_back(text):
    assert OmegaConf.create({"text": escape(text)}).text == text
    # 100 kB from a file; a search that starts at every backslash takes a minute
    text, started = "\\" * 100_000, time.process_time()
    assert escape(text) == text and time.process_time() - started < 1
