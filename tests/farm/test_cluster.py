"""What a cluster has and what a worker gets, without a cluster."""

import pytest

from threestudio_gaussiandreamer.farm.cluster import Device, choose_device, count_workers

CPU, GPUS = {"CPU": 8.0}, {"CPU": 8.0, "GPU": 2.0}


def test_a_worker_gets_a_gpu_where_there_is_one():
    assert choose_device(GPUS, None, 1) == Device(1, 1)
    assert choose_device(GPUS, 0, 1) == choose_device(CPU, None, 1) == Device(0, 1)


def test_as_many_workers_as_fit():
    assert count_workers(CPU, Device(0, 3), None, None) == 2
    assert count_workers(GPUS, Device(1, 1), None, None) == 2
    assert count_workers(GPUS, Device(1, 1), 1, None) == 1
    assert count_workers(GPUS, Device(1, 5), None, None) == 1
    assert count_workers(CPU, Device(0, 1), None, 3) == 3


@pytest.mark.parametrize(
    ("act", "message"),
    [
        (lambda: choose_device(CPU, 1, 1), "--gpus 1: the cluster has no GPU; give none"),
        (lambda: choose_device(CPU, None, 9), "--cores 9: the cluster has 8 cores"),
        (lambda: count_workers(CPU, Device(0, 4), None, 3), "with 4 cores each, 2 fit"),
        (lambda: count_workers(GPUS, Device(1, 1), None, 3), "with 1 GPU each, 2 fit"),
    ],
)
def test_more_than_there_is_is_refused(act, message):
    with pytest.raises(ValueError, match=message):
        act()
