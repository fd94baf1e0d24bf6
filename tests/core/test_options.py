"""Rules declared at the fields of a ``Config``, and the function that checks them."""

from dataclasses import dataclass, field
from typing import Any, List, Optional, Tuple

import pytest
from omegaconf import OmegaConf

from threestudio_gaussiandreamer.core import options
from threestudio_gaussiandreamer.core.errors import UserError
from threestudio_gaussiandreamer.core.nested import adopt_nested
from threestudio_gaussiandreamer.core.options import check_options, checked_options
from threestudio_gaussiandreamer.core.schedule import C


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

    def __post_init__(self) -> None:
        adopt_nested(self)

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
]


@pytest.mark.parametrize(("values", "message"), WRONG)
@pytest.mark.parametrize("typed", [lambda x: x, OmegaConf.structured], ids=["plain", "omegaconf"])
def test_a_value_out_of_range_is_named_with_its_path(typed, values, message):
    with pytest.raises(UserError) as error:
        check_options(Options, typed(Options(**values)), "a.")
    # OmegaConf converts whole numbers of float fields
    assert (
        str(error.value)
        .replace(", got 0.0", ", got 0")
        .startswith(message.replace(", got 0.0", ", got 0").removesuffix(".0"))
    )


def test_values_in_range_pass():
    check_options(Options, Options())
    limits = {"share": 1e-9, "degree": 3, "rate": [0, 0.0, 1.0, 5], "pair": [3, 3], "size": 1}
    check_options(Options, OmegaConf.structured(Options(**limits, free=[2**63 - 1, 3.4e38])))


def test_a_message_that_gives_the_whole_path_keeps_it():
    @dataclass
    class Foreign:
        size: int = 1

        @staticmethod
        def check(cfg: Any) -> None:
            raise UserError("system.guidance.size is too small")

    with pytest.raises(UserError, match="^system.guidance.size is too small$"):
        check_options(Foreign, Foreign(), "system.guidance.")


def test_checked_options_are_plain_attributes_with_parsed_schedules():
    given = {"rate": [0, 0.2, 0.6, 4], "pair": [1, 2], "free": {"a": [1, {"b": 2}]}}
    options = checked_options(Options, OmegaConf.structured(Options(**given)))
    assert options.pair == [1, 2] and type(options.pair) is list
    assert options.free == {"a": [1, {"b": 2}]} and type(options.free["a"]) is list
    assert [C(options.rate, 0, step) for step in (0, 2, 9)] == [0.2, 0.4, 0.6]
    assert C(checked_options(Options, Options(rate=0.7)).rate, 0, 3) == 0.7


def test_checked_options_refuse_what_check_options_refuses():
    with pytest.raises(UserError, match="^a.size"):
        checked_options(Options, Options(size=0), "a.")


def test_a_check_may_raise_any_value_error():
    """Not everybody knows of UserError."""

    @dataclass
    class Config:
        low: int = 3
        high: int = 2

        @staticmethod
        def check(cfg: Any) -> None:
            raise ValueError("low: expected less than high")

    with pytest.raises(UserError, match="part.low: expected less than high"):
        check_options(Config, Config(), "part.")
