"""Random lives of a cloud, a few of what `make fuzz` tries."""

import pytest
import torch
from hypothesis import HealthCheck, Phase, settings
from hypothesis.stateful import run_state_machine_as_test

from tests.fuzz.sequences import CloudLife
from threestudio_gaussiandreamer.gaussians import densify

pytestmark = pytest.mark.slow


def live(lives: int, **options) -> None:
    health = list(HealthCheck)
    run_state_machine_as_test(
        CloudLife,
        settings=settings(
            max_examples=lives,
            stateful_step_count=20,
            derandomize=True,
            deadline=None,
            database=None,
            suppress_health_check=health,
            **options,
        ),
    )


def test_no_life_breaks_a_cloud():
    live(30)


def test_a_split_beyond_floats_is_found(monkeypatch):
    """Without the limit of densify, a Gaussian of infinite size has children at infinity."""
    monkeypatch.setattr(densify, "LOG_SCALE_RANGE", (-1e30, 1e30))
    life = CloudLife()
    life.start(count=20, floor=1, cap=500, seed=0)
    with torch.no_grad():
        life.cloud.log_scales.fill_(300.0)
    with pytest.raises(AssertionError, match="isn't finite"):
        life.densify(seed=1, threshold=0.0, split=0.05, faint=0.0, huge=1e30)
        life.everything_fits()


def test_moments_that_go_astray_are_found(monkeypatch):
    def rows(value, old, change):
        return (
            value[change.parents.roll(1)] if getattr(value, "shape", None) == old.shape else value
        )

    monkeypatch.setattr(densify, "_rows", rows)
    with pytest.raises(AssertionError):
        live(200, phases=[Phase.generate])
