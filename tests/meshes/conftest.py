"""Fixtures of the mesh tests."""

import pytest


@pytest.fixture
def saved(tmp_path):
    def save(made, name="a.glb"):
        path = tmp_path / name
        path.write_bytes(made.glb())
        return path

    return save
