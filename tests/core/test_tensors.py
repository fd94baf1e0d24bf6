"""Draws, rotations, given gradients, and copies of a GPU's values."""

import itertools
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from threestudio_gaussiandreamer.core import streams
from threestudio_gaussiandreamer.core.devices import DelayedReads, HostCopy, flush_reads
from threestudio_gaussiandreamer.core.tensors import given_gradient, rotation_rows


def test_a_draw_is_a_function_of_its_key_only():
    first = torch.rand(4, generator=streams.generator(1, "camera", 7))
    torch.rand(100)
    torch.manual_seed(5)
    assert torch.equal(first, torch.rand(4, generator=streams.generator(1, "camera", 7)))
    one, again = (streams.numpy_generator(1, "grow").random(3) for _ in range(2))
    assert (one == again).all()
    keys = list(itertools.product((0, 1), ("camera", "noise"), (0, 1, 11), (0, 1)))
    assert len({streams.derive_seed(*key) for key in keys}) == len(keys)
    assert streams.derive_seed(0, "a", 1, 11) != streams.derive_seed(0, "a", 11, 1)


def test_the_noise_of_an_item_does_not_depend_on_the_batch():
    four = streams.normal_per_item((4, 2, 3), 0, "noise", 9)
    assert torch.equal(streams.normal_per_item((2, 2, 3), 0, "noise", 9), four[:2])
    assert streams.normal_per_item((0, 2), 0, "noise", 9).shape == (0, 2)
    many = streams.normal_per_item((8, 1000), 0, "noise", 0)
    assert abs(float(many.std()) - 1) < 0.05  # 8000 draws: 6 standard errors


def test_the_rows_of_a_rotation_are_those_of_scipy_for_arrays_and_tensors():
    quats = np.random.default_rng(0).normal(size=(20, 4))
    quats /= np.linalg.norm(quats, axis=1, keepdims=True)
    rows = np.moveaxis(np.array(rotation_rows(*quats.T)), -1, 0)
    expected = Rotation.from_quat(quats[:, [1, 2, 3, 0]]).as_matrix()
    np.testing.assert_allclose(rows, expected, atol=1e-14)
    tensors = rotation_rows(*torch.from_numpy(quats).unbind(1))
    stacked = torch.stack([torch.stack(row, -1) for row in tensors], 1)
    assert torch.equal(stacked, torch.from_numpy(rows))


@pytest.mark.parametrize("factor", [1.0, 0.5, -3.0, 0.0])
def test_the_gradient_is_the_given_one_times_what_follows_and_is_not_shared(factor):
    x, gradient = torch.randn(2, 3, requires_grad=True), torch.randn(2, 3)
    given, number = gradient.clone(), given_gradient(x, gradient, torch.tensor(7.0))
    (factor * number).backward(retain_graph=True)
    assert number == 7 and torch.equal(x.grad, factor * gradient)
    (factor * number).backward()
    assert torch.equal(x.grad, 2 * factor * gradient)
    x.grad.zero_()
    assert torch.equal(gradient, given)


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


def test_what_the_use_of_a_value_raises_is_raised_once(arrive):
    def fail(values):
        raise ValueError(int(values))

    reads, used = DelayedReads(), []
    reads.submit(torch.tensor(1), fail)
    reads.submit(torch.tensor(2), used.append)
    with pytest.raises(ValueError, match="1"):
        reads.poll(wait=True)
    reads.poll(wait=True)
    assert used == [2]
