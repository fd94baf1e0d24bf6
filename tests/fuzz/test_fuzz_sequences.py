"""A sample of `make fuzz`: random sequences of operations on a cloud."""

import pytest
import torch
from hypothesis import HealthCheck, Phase, settings
from hypothesis.stateful import run_state_machine_as_test

from tests.fuzz.sequences import CloudSequence
from threestudio_gaussiandreamer.gaussians import densify

pytestmark = pytest.mark.slow


def run_sequences(count: int, **options) -> None:
    health = list(HealthCheck)
    run_state_machine_as_test(
        CloudSequence,
        settings=settings(
            max_examples=count,
            stateful_step_count=20,
            derandomize=True,
            deadline=None,
            database=None,
            suppress_health_check=health,
            **options,
        ),
    )


def test_no_sequence_breaks_a_cloud(monkeypatch):
    """Invariants hold after every rule: finite parameters, moments of the right rows, the cap."""
    monkeypatch.setattr(CloudSequence, "steps", 0)
    run_sequences(30)
    assert CloudSequence.steps > 200


def test_a_split_beyond_floats_is_detected(monkeypatch):
    """Without the limit of densify, a Gaussian of infinite size has children at infinity."""
    monkeypatch.setattr(densify, "LOG_SCALE_RANGE", (-1e30, 1e30))
    sequence = CloudSequence()
    sequence.start(count=20, floor=1, cap=500, seed=0)
    with torch.no_grad():
        sequence.cloud.log_scales.fill_(300.0)
    with pytest.raises(AssertionError, match="isn't finite"):
        sequence.densify(seed=1, threshold=0.0, split=0.05, faint=0.0, huge=1e30)
        sequence.everything_fits()


def test_misplaced_moments_are_detected(monkeypatch):
    def rows(value, old, change):
        return (
            value[change.parents.roll(1)] if getattr(value, "shape", None) == old.shape else value
        )

    monkeypatch.setattr(densify, "_rows", rows)
    with pytest.raises(AssertionError):
        run_sequences(200, phases=[Phase.generate])
