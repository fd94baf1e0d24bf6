"""Damaged files at every door, a few of what `make fuzz` tries; and every one that was ever taken
wrongly, kept in corpus/.
"""

import time
from pathlib import Path

import numpy as np
import pytest

from tests.fuzz.judge import judged, outcomes
from tests.fuzz.mutations import BINARY, TEXT, mutant
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
"""How many damaged files of a kind; of others 70."""


@pytest.mark.parametrize("name", TARGETS)
def test_damaged_files_are_read_rightly_or_refused(name):
    ended = dict(outcomes(name, range(INPUTS.get(name, 70)), seed=1))
    failed = {index: outcome.detail for index, outcome in ended.items() if outcome.kind == "failed"}
    assert not failed, failed
    assert any(outcome.kind == "refused" for outcome in ended.values())


@pytest.mark.parametrize("name", TARGETS)
def test_good_files_are_read(name):
    assert [judged(TARGETS[name], data) for data in seeds(name)] == [("read", "")] * len(
        seeds(name)
    )


@pytest.mark.parametrize("path", CORPUS, ids=lambda path: f"{path.parent.name}-{path.stem}")
def test_what_was_taken_wrongly_once_is_refused(path):
    outcome = judged(TARGETS[path.parent.name], path.read_bytes())
    assert outcome.kind == "refused", outcome


# ---- can it fail? --------------------------------------------------------------------------------


def crash(path: Path) -> None:
    raise IndexError("list index out of range")


def hang(path: Path) -> None:
    while True:
        try:
            time.process_time()
        except Exception:
            pass


def misread(path: Path) -> None:
    raise Misread("it isn't what it says")


def believe(path: Path) -> None:
    np.ones(200 << 20, np.uint8)


@pytest.mark.parametrize("door", [crash, hang, misread, believe])
def test_a_faulty_door_is_seen(door, monkeypatch):
    monkeypatch.setattr("tests.fuzz.judge.SECONDS", 0.2 if door is hang else 60)
    outcome = judged(Target(".bin", list, door), b"0123")
    assert outcome.kind == "failed"
    assert (
        outcome.detail.split(":")[0]
        == {crash: "crash", hang: "hang", misread: "misread", believe: "memory"}[door]
    )


def test_a_refusal_is_none():
    def refuse(path: Path) -> None:
        raise UserError("no")

    assert judged(Target(".bin", list, refuse), b"0123") == ("refused", "no")


@pytest.mark.parametrize("mutators", [BINARY, TEXT])
def test_mutants_are_repeatable_and_differ(mutators):
    data = [b"element vertex 12\nproperty float x\n" * 5]
    ours, again = (
        [mutant(data, np.random.default_rng(i), mutators, None) for i in range(200)]
        for _ in range(2)
    )
    assert ours == again
    assert len(set(ours)) > 150 and data[0] not in ours[:20]
