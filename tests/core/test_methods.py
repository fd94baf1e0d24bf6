"""Methods that a user's part lacks, or that can't be called, are named with how they are called."""

import functools
from abc import abstractmethod

import pytest

from threestudio_gaussiandreamer.core.errors import UserError
from threestudio_gaussiandreamer.core.methods import (
    find_method,
    require_class_method,
    require_method,
)


class Base:
    @abstractmethod
    def unfinished(self, a):
        """Do something."""

    def inherited(self, a, b):
        """Do something."""


class Part(Base):
    def with_default(self, a, b, c=3):
        """Do something."""

    def rest(self, *arguments):
        """Do something."""

    @classmethod
    def of_class(cls, a, b):
        """Do something."""

    @staticmethod
    def static(a, b):
        """Do something."""

    def one(self, a):
        """Do something."""

    def three(self, a, b, c):
        """Do something."""

    partly = functools.partialmethod(three, c=1)
    bound = functools.partial(three, None, c=1)
    number = 3


CALLABLE = ["inherited", "with_default", "rest", "of_class", "static", "partly", "bound"]
WRONG = {
    **dict.fromkeys(["missing", "unfinished", "__call__", "number"], r"Part has no {}\(a, b\)"),
    "one": r"Part has one\(self, .*called as one\(a, b\): too many positional arguments",
    "three": r"Part has three\(self, .*called as three\(a, b\): missing .*'c'",
}


@pytest.mark.parametrize("name", CALLABLE)
def test_methods_that_take_the_arguments_are_accepted(name):
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
