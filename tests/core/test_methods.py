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


@pytest.mark.parametrize("name", ["inherited", "with_default", "rest", "of_class", "static"])
def test_methods_that_take_the_arguments_are_accepted(name):
    require_method(Part, name, "a", "b")


@pytest.mark.parametrize("name", ["missing", "unfinished", "__call__"])
def test_missing_and_abstract_methods_are_named(name):
    assert find_method(Part, name) is None
    with pytest.raises(UserError, match=rf"Part has no {name}\(a, b\)"):
        require_method(Part, name, "a", "b")


@pytest.mark.parametrize(
    ("name", "cause"), [("one", "too many positional arguments"), ("three", "missing .*'c'")]
)
def test_other_arguments_are_refused(name, cause):
    with pytest.raises(
        UserError, match=rf"Part has {name}\(self, .*called as {name}\(a, b\): {cause}"
    ):
        require_method(Part, name, "a", "b")


class Wrapped:
    @functools.lru_cache  # noqa: B019
    def cached(self, a, b):
        """Do something."""

    partly = functools.partialmethod(Part.three, c=1)
    bound = functools.partial(max, 1)
    number = 3

    @property
    def computed(self):
        return lambda a, b: None


@pytest.mark.parametrize("name", ["cached", "partly", "bound"])
def test_methods_that_are_no_functions_are_accepted_if_they_can_be_called(name):
    require_method(Wrapped, name, "a", "b")


@pytest.mark.parametrize("name", ["number", "computed"])
def test_what_is_no_method_is_refused(name):
    with pytest.raises(UserError, match=rf"Wrapped has no {name}\(a, b\)"):
        require_method(Wrapped, name, "a", "b")


def test_a_method_of_instances_is_no_class_method():
    for name in ("of_class", "static", "missing"):
        require_class_method(Part, name)
    with pytest.raises(UserError, match="Part.one needs @classmethod above it"):
        require_class_method(Part, "one")
