"""A sample of `make fuzz`: damaged files for every reader, and corpus/, the files of earlier
defects.
"""

import time
from pathlib import Path

import numpy as np
import pytest

from tests.fuzz.mutations import BINARY, TEXT, mutant
from tests.fuzz.runner import outcome_of, outcomes
from tests.fuzz.target import Misread, Target
from tests.fuzz.targets import TARGETS, seeds
from threestudio_gaussiandreamer.core.errors import UserError

pytestmark = pytest.mark.slow

CORPUS = sorted(path for path in Path(__file__).with_name("corpus").rglob("*") if path.is_file())
INPUTS = {
    "configuration": 25,
    "config-values": 60,
    "checkpoint-content": 60,
    "command-line": 15,
    "checkpoint": 30,
}
"""Number of damaged files per target; 70 for the others."""


@pytest.mark.parametrize("name", TARGETS)
def test_damaged_files_are_read_correctly_or_refused(name):
    ended = dict(outcomes(name, range(INPUTS.get(name, 70)), seed=1))
    failed = {index: outcome.detail for index, outcome in ended.items() if outcome.kind == "failed"}
    assert not failed, failed
    assert any(outcome.kind == "refused" for outcome in ended.values())


@pytest.mark.parametrize("name", TARGETS)
def test_valid_files_are_read(name):
    assert [outcome_of(TARGETS[name], data) for data in seeds(name)] == [("read", "")] * len(
        seeds(name)
    )


@pytest.mark.parametrize("path", CORPUS, ids=lambda path: f"{path.parent.name}-{path.stem}")
def test_a_file_of_an_earlier_defect_is_refused(path):
    outcome = outcome_of(TARGETS[path.parent.name], path.read_bytes())
    assert outcome.kind == "refused", outcome


# ---- tests of the runner -------------------------------------------------------------------------


def crash(path: Path) -> None:
    raise IndexError("list index out of range")


def hang(path: Path) -> None:
    while True:
        try:
            time.process_time()
        except Exception:
            pass


def misread(path: Path) -> None:
    raise Misread("another content")


def allocate(path: Path) -> None:
    np.ones(200 << 20, np.uint8)


@pytest.mark.parametrize("reader", [crash, hang, misread, allocate])
def test_a_faulty_reader_is_detected(reader, monkeypatch):
    monkeypatch.setattr("tests.fuzz.runner.SECONDS", 0.2 if reader is hang else 60)
    outcome = outcome_of(Target(".bin", list, reader), b"0123")
    assert outcome.kind == "failed"
    assert (
        outcome.detail.split(":")[0]
        == {crash: "crash", hang: "hang", misread: "misread", allocate: "memory"}[reader]
    )


def test_a_user_error_is_a_refusal():
    def refuse(path: Path) -> None:
        raise UserError("no")

    assert outcome_of(Target(".bin", list, refuse), b"0123") == ("refused", "no")


@pytest.mark.parametrize("mutators", [BINARY, TEXT])
def test_mutants_are_repeatable_and_differ(mutators):
    data = [b"element vertex 12\nproperty float x\n" * 5]
    ours, again = (
        [mutant(data, np.random.default_rng(i), mutators, None) for i in range(200)]
        for _ in range(2)
    )
    assert ours == again
    assert len(set(ours)) > 150 and data[0] not in ours[:20]
