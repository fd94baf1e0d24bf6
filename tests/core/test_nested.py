"""Unspecified options of a partly specified group keep their defaults."""

from dataclasses import dataclass, field

import pytest
from omegaconf import OmegaConf

from threestudio_gaussiandreamer.core.nested import adopt_nested


@dataclass
class Inner:
    a: int = 1
    b: float = 2.0


@dataclass
class Outer:
    inner: Inner = field(default_factory=Inner)
    free: dict = field(default_factory=dict)

    def __post_init__(self):
        adopt_nested(self)


@pytest.mark.parametrize("wrap", [dict, OmegaConf.create])
def test_missing_keys_keep_their_defaults_and_stay_typed(wrap):
    cfg = OmegaConf.structured(Outer(**wrap({"inner": {"a": 5}, "free": {"x": 1}})))
    assert cfg.inner.a == 5 and cfg.inner.b == 2.0 and cfg.free.x == 1
    with pytest.raises(Exception, match="b"):
        cfg.inner.b = "text"


def test_an_unknown_key_is_an_error():
    with pytest.raises(TypeError, match="c"):
        Outer(inner={"c": 1})
