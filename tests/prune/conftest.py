"""Fixtures of the pruning tests."""

import pytest

from tests.helpers.pruning import ball
from threestudio_gaussiandreamer.formats.ply import write_gaussians


@pytest.fixture
def source(tmp_path):
    path = tmp_path / "in.ply"
    write_gaussians(path, ball().arrays())
    return path
