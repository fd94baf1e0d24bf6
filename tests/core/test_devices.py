"""Which device a process computes on, and the number of threads."""

from concurrent.futures import ThreadPoolExecutor

import pytest
import torch

from threestudio_gaussiandreamer.core.devices import get_device, torch_threads, without_autocast


@pytest.mark.parametrize(
    ("ranks", "index"), [({}, 0), ({"LOCAL_RANK": "3"}, 3), ({"SLURM_LOCALID": "2"}, 2)]
)
def test_each_process_of_a_machine_has_its_own_gpu(monkeypatch, ranks, index):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    for name in ("LOCAL_RANK", "SLURM_LOCALID"):
        monkeypatch.delenv(name, raising=False)
    for name, value in ranks.items():
        monkeypatch.setenv(name, value)
    assert get_device() == torch.device("cuda", index)


def test_threads_hold_for_new_threads_until_the_end():
    with torch_threads(3):
        with pytest.raises(ValueError), torch_threads(1), ThreadPoolExecutor(1) as pool:
            assert [torch.get_num_threads(), pool.submit(torch.get_num_threads).result()] == [1, 1]
            raise ValueError
        assert torch.get_num_threads() == 3


@pytest.mark.parametrize("enabled", [True, False])
def test_without_autocast_it_is_off_and_afterwards_as_before(enabled):
    with torch.autocast("cpu", torch.bfloat16, enabled=enabled):
        with without_autocast("cpu"):
            assert not torch.is_autocast_enabled("cpu")
        assert torch.is_autocast_enabled("cpu") == enabled
