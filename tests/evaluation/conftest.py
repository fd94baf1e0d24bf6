"""Fixtures of the evaluation tests."""

import pytest

from tests.evaluation.clip_similarity_cases import blob, save


@pytest.fixture
def plys(tmp_path):
    return [str(save(tmp_path / f"{i}.ply", blob(seed=i))) for i in range(2)]
