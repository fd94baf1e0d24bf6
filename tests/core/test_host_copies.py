"""Values of a GPU, used in order and without waiting for them; as on a CPU, at once."""

from types import SimpleNamespace

import pytest
import torch

from threestudio_gaussiandreamer.core.host_copies import DelayedReads, HostCopy, flush_reads


@pytest.fixture
def arrive(monkeypatch):
    """Let values arrive only when the test says so; returns a function that says it."""
    arrived = set()
    monkeypatch.setattr(HostCopy, "ready", lambda copy: int(copy.values()) in arrived)
    return arrived.add


def test_values_of_a_cpu_are_used_at_once():
    reads, used = DelayedReads(), []
    reads.submit(torch.tensor(3), used.append)
    assert used == [torch.tensor(3)]


def test_values_are_used_in_order_once_they_have_arrived(arrive):
    reads, used = DelayedReads(), []
    for number in (1, 2, 3):
        reads.submit(torch.tensor(number), used.append)
    assert not used
    arrive(1), arrive(3)
    reads.poll()
    assert used == [1]
    arrive(2)
    reads.submit(torch.tensor(4), used.append)
    assert used == [1, 2, 3]
    flush_reads(None, SimpleNamespace(reads="another package's"), SimpleNamespace(reads=reads))
    assert used == [1, 2, 3, 4]


def test_what_the_use_raises_is_raised_once(arrive):
    def fail(values):
        raise ValueError(int(values))

    reads, used = DelayedReads(), []
    reads.submit(torch.tensor(1), fail)
    reads.submit(torch.tensor(2), used.append)
    with pytest.raises(ValueError, match="1"):
        reads.poll(wait=True)
    reads.poll(wait=True)
    assert used == [2]
