"""Methods that a user's part lacks, or that can't be called, are named with how they are called."""

import functools
from abc import abstractmethod

import pytest

from threestudio_gaussiandreamer.core.errors import UserError
from threestudio_gaussiandreamer.host.methods import (
    find_method,
    require_class_method,
    require_method,
)


class Base:
    @abstractmethod
    def unfinished(self, a): ...
    def inherited(self, a, b): ...


class Part(Base):
    def with_default(self, a, b, c=3): ...
    def rest(self, *arguments): ...
    @classmethod
    def of_class(cls, a, b): ...
    @staticmethod
    def static(a, b): ...
    def one(self, a): ...
    def three(self, a, b, c): ...

    partly = functools.partialmethod(three, c=1)
    bound = functools.partial(three, None, c=1)
    number = 3


WRONG = {
    **dict.fromkeys(["missing", "unfinished", "__call__", "number"], r"Part has no {}\(a, b\)"),
    "one": r"Part has one\(self, .*called as one\(a, b\): too many positional arguments",
    "three": r"Part has three\(self, .*called as three\(a, b\): missing .*'c'",
}


def test_methods_that_take_the_arguments_are_accepted():
    for name in "inherited with_default rest of_class static partly bound".split():
        require_method(Part, name, "a", "b")


@pytest.mark.parametrize("name", WRONG)
def test_other_methods_are_named(name):
    with pytest.raises(UserError, match=WRONG[name].format(name)):
        require_method(Part, name, "a", "b")
    assert (find_method(Part, name) is None) == (name in ("missing", "unfinished", "__call__"))


def test_a_method_of_instances_is_no_class_method():
    for name in ("of_class", "static", "missing"):
        require_class_method(Part, name)
    with pytest.raises(UserError, match="Part.one needs @classmethod above it"):
        require_class_method(Part, "one")
