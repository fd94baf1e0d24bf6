"""What users are told about wrong input."""

from collections.abc import Callable
from typing import Any

import pytest

from threestudio_gaussiandreamer.core.errors import UserError


def refused(said: str, call: Callable[..., Any], *arguments: Any, **options: Any) -> None:
    """Assert that a call raises a ``UserError`` whose text the regular expression matches."""
    with pytest.raises(UserError, match=said):
        call(*arguments, **options)
