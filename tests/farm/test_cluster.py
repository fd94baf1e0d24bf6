"""What a cluster has and what a worker gets, without a cluster."""

import pytest

from threestudio_gaussiandreamer.farm.driver import plan_workers

CPU, GPUS = {"CPU": 8.0}, {"CPU": 8.0, "GPU": 2.0}


@pytest.mark.parametrize(
    ("resources", "gpus", "cores", "workers", "plan"),
    [
        (GPUS, None, 1, None, (2, 1)),
        (GPUS, 1, 1, None, (1, 1)),
        (GPUS, None, 5, None, (1, 1)),
        (GPUS, 0, 1, None, (8, 0)),
        (CPU, None, 3, None, (2, 0)),
        (CPU, None, 1, 3, (3, 0)),
    ],
)
def test_a_worker_gets_a_gpu_where_there_is_one_and_as_many_start_as_fit(
    resources, gpus, cores, workers, plan
):
    assert plan_workers(resources, gpus, cores, workers) == plan


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ((CPU, 1, 1, None), "--gpus 1: the cluster has no GPU; give none"),
        ((CPU, None, 9, None), "--cores 9: the cluster has 8 cores"),
        ((CPU, None, 4, 3), "with 4 cores each, 2 fit"),
        ((GPUS, None, 1, 3), "with 1 GPU each, 2 fit"),
    ],
)
def test_more_than_there_is_is_refused(options, message):
    with pytest.raises(ValueError, match=message):
        plan_workers(*options)
