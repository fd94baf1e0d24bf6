"""A sample of `make fuzz`, and corpus/, the files of earlier defects."""

import contextlib
import functools
import time
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest

from tests.fuzz import scenes
from tests.fuzz.scenes import disagreement, draw, fault, well_posed
from tests.fuzz.sequences import CloudSequence, run_sequences
from tests.fuzz.targets import TARGETS, Target, outcome_of, outcomes, seeds
from tests.stability.backends import BACKENDS, backends_of, cuda_on_the_host

pytestmark = pytest.mark.slow

CORPUS = sorted(path for path in Path(__file__).with_name("corpus").rglob("*") if path.is_file())
INPUTS = {"configuration": 25, "command-line": 15, "checkpoint": 30}
"""Number of damaged files per target; 50 for the others."""
SCENES, MOST = range(12), 600
ORDINARY = 8
"""Seed of a scene that is mostly well-posed."""


@pytest.mark.parametrize("name", TARGETS)
def test_files_are_read_correctly_or_refused(name):
    """All valid ones are read."""
    assert {outcome_of(TARGETS[name], data) for data in seeds(name)} == {("read", "")}
    ended = dict(outcomes(name, range(INPUTS.get(name, 50)), seed=1))
    failed = {index: outcome.detail for index, outcome in ended.items() if outcome.kind == "failed"}
    assert not failed, failed
    assert any(outcome.kind == "refused" for outcome in ended.values())


@pytest.mark.parametrize("path", CORPUS, ids=lambda path: f"{path.parent.name}-{path.stem}")
def test_a_file_of_an_earlier_defect_is_refused(path):
    assert seeds(path.parent.name)
    outcome = outcome_of(TARGETS[path.parent.name], path.read_bytes())
    assert outcome.kind == "refused", outcome


def hang(path: Path) -> None:
    while True:
        with contextlib.suppress(Exception):
            time.process_time()


@pytest.mark.parametrize(
    "fault, reader",
    [
        ("crash", Mock(side_effect=IndexError("list index out of range"))),
        ("hang", hang),
        ("misread", Mock(side_effect=AssertionError("another content"))),
        ("memory", lambda path: np.ones(200 << 20, np.uint8)),
    ],
)
def test_a_faulty_reader_is_detected(fault, reader, monkeypatch):
    monkeypatch.setattr("tests.fuzz.targets.SECONDS", 0.2 if reader is hang else 60)
    outcome = outcome_of(Target(".bin", list, reader), b"0123")
    assert outcome.kind == "failed" and outcome.detail.startswith(f"{fault}: ")


scene = functools.cache(functools.partial(scenes.extreme_scene, most=MOST))


@pytest.fixture
def stand_in_for_a_gpu(monkeypatch) -> None:
    if "cuda" in BACKENDS:
        cuda_on_the_host(monkeypatch)


@pytest.mark.parametrize("backend", backends_of())
def test_nothing_that_is_drawn_is_nan(backend, stand_in_for_a_gpu):
    faults = {seed: scenes.fault_of(scene(seed), backend) for seed in SCENES}
    assert not any(faults.values()), faults


def test_backends_agree_on_what_is_well_posed(stand_in_for_a_gpu):
    parts = {seed: well_posed(scene(seed)) for seed in SCENES}
    faults = {seed: scenes.disagreement_on(part, BACKENDS) for seed, part in parts.items()}
    assert not any(faults.values()), faults
    assert sum(len(part.cloud.means) for part in parts.values()) > 500, "too little is well-posed"


def test_wrong_renders_and_backends_that_differ_are_detected():
    drawn = draw(scene(ORDINARY), "torch")
    assert fault(scene(ORDINARY), drawn) is None
    for name, value in {"image": float("nan"), "alpha": 1.5, "depth": float("inf")}.items():
        wrong = getattr(drawn.out, name).detach().clone()
        wrong[0, 0, 0] = value
        assert fault(scene(ORDINARY), drawn._replace(out=drawn.out._replace(**{name: wrong})))
    drawn.grads["quats"][0, 0] = float("nan")
    assert fault(scene(ORDINARY), drawn)
    part = well_posed(scene(ORDINARY))
    one, other = draw(part, "reference"), draw(part, "torch")
    assert disagreement({"one": one, "other": other}) is None
    shifted = other._replace(out=other.out._replace(image=1.1 * other.out.image))
    assert "image" in disagreement({"one": one, "other": shifted})
    wrong = other._replace(grads=other.grads | {"means": other.grads["means"].flip(1)})
    assert "means" in disagreement({"one": one, "other": wrong})


def test_no_sequence_breaks_a_cloud(monkeypatch):
    """Invariants hold after every rule: finite parameters, moments of the right rows, the cap."""
    monkeypatch.setattr(CloudSequence, "steps", 0)
    run_sequences(30)
    assert CloudSequence.steps > 200
