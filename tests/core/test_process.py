"""What a process is given: its rank, device, threads and memory."""

from concurrent.futures import ThreadPoolExecutor

import pytest
import torch

from threestudio_gaussiandreamer.core import options
from threestudio_gaussiandreamer.core import options as memory
from threestudio_gaussiandreamer.core.devices import get_device, torch_threads, without_autocast
from threestudio_gaussiandreamer.core.errors import UserError
from threestudio_gaussiandreamer.core.logs import get_rank

RANKS = ("RANK", "SLURM_PROCID", "JSM_NAMESPACE_RANK", "NODE_RANK", "LOCAL_RANK", "SLURM_LOCALID")


@pytest.mark.parametrize(
    ("variables", "first", "gpu"),
    [
        ({}, True, 0),
        ({"RANK": "0", "LOCAL_RANK": "0"}, True, 0),
        ({"RANK": "2", "LOCAL_RANK": "0"}, False, 0),  # torchrun on the second machine
        ({"RANK": "3", "LOCAL_RANK": "3"}, False, 3),
        ({"SLURM_PROCID": "1", "SLURM_LOCALID": "0"}, False, 0),
        ({"SLURM_PROCID": "2", "SLURM_LOCALID": "2"}, False, 2),
        ({"LOCAL_RANK": "1"}, False, 1),  # started by Lightning
        ({"NODE_RANK": "1"}, False, 0),
        ({"NODE_RANK": "0", "LOCAL_RANK": "0"}, True, 0),
    ],
)
def test_only_the_first_process_logs_and_each_of_a_machine_has_its_own_gpu(
    monkeypatch, variables, first, gpu
):
    """Before torch.distributed is initialised."""
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    for name in RANKS:
        monkeypatch.delenv(name, raising=False)
    for name, value in variables.items():
        monkeypatch.setenv(name, value)
    assert (get_rank() == 0) is first
    assert get_device() == torch.device("cuda", gpu)


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


def test_what_is_larger_than_the_memory_is_refused_before_any_work(monkeypatch):
    monkeypatch.setattr(memory, "memory_bytes", lambda: 1000)
    memory.require_memory("size", 1000, "pictures")
    with pytest.raises(UserError, match="^size: pictures take about 2 kB of memory, .* 1 kB"):
        memory.require_memory("size", 2000, "pictures")
    rule = memory.count_of("points", 1, bytes_each=100)[options.RULE]
    rule("n", 10)
    for wrong, message in ((11, "n: 11 points take"), (0, "n: expected 1 or more points, got 0")):
        with pytest.raises(UserError, match=message):
            rule("n", wrong)


def test_the_memory_of_a_container_counts(monkeypatch, tmp_path):
    whole = memory.main_memory()
    assert whole > 2**28
    monkeypatch.setattr(memory, "CGROUP_LIMIT", tmp_path / "limit")
    for text, bound in (("123456\n", 123456), ("max\n", whole)):
        (tmp_path / "limit").write_text(text)
        assert memory.main_memory() == bound
