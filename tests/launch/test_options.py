"""Arguments, before heavy imports: usage, configuration files by name, GPUs; what is imported."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from benchmarks.start.first_step import PROBE, ROOT
from benchmarks.start.launched import run_with_probe
from tests.training.runs import SMALL
from threestudio_gaussiandreamer.core.errors import UserError
from threestudio_gaussiandreamer.launch import experiment, options
from threestudio_gaussiandreamer.launch.options import announce_device, choose_gpu, find_config

UNUSED = {
    "trimesh", "networkx", "diffusers", "transformers", "viser", "imageio", "matplotlib",
    "tensorboard.backend", "accelerate", "scipy.stats", "scipy.signal", "torchmetrics.functional",
    "torch._dynamo.eval_frame", "sympy",
}  # fmt: skip


def test_help_imports_neither_torch_nor_lightning():
    code = (
        "import sys; from threestudio_gaussiandreamer.launch.experiment import main\n"
        "assert main(['--help']) == 0; print('torch' in sys.modules, 'omegaconf' in sys.modules)"
    )
    line = [sys.executable, "-c", code]
    done = subprocess.run(line, cwd=ROOT, capture_output=True, text=True)
    assert done.stdout.startswith("usage:") and done.stdout.endswith("False False\n"), done.stderr


@pytest.mark.slow
def test_a_demo_run_imports_nothing_heavy_that_it_does_not_use():
    modules = set(run_with_probe(PROBE, ROOT, *SMALL)["modules"])
    assert {"torch", "lightning", "threestudio_gaussiandreamer.training.system"} <= modules
    assert not UNUSED & modules


@pytest.mark.slow
def test_the_commands_for_files_import_no_lightning():
    """It takes three times as long as what they use."""
    rooms = ("convert", "prune", "view")
    names = ", ".join(f"threestudio_gaussiandreamer.{room}.command" for room in rooms)
    code = f"import sys, {names}; print(*sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    modules = set(done.stdout.split())
    assert "torch" in modules and not {"lightning", "pytorch_lightning", "omegaconf"} & modules


@pytest.mark.parametrize("said", [{}, {"OMP_WAIT_POLICY": "passive"}, {"GOMP_SPINCOUNT": "7"}])
def test_idle_threads_wait_as_the_user_says(monkeypatch, said):
    monkeypatch.setattr(os, "environ", dict(said))
    experiment.limit_openmp_spin()
    assert os.environ == (said or {"GOMP_SPINCOUNT": "10000", "KMP_BLOCKTIME": "0"})


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "required: --config"),
        (["--config", "a.yaml"], "arguments --train --validate --test --export is required"),
        (["--config", "a.yaml", "--train", "--test"], "not allowed with argument"),
        (["--config", "a.yaml", "--train", "--tarin"], "unrecognized option --tarin"),
        (["--config", "a.yaml", "--tra"], "is required"),
    ],
)
def test_usage_mistakes_exit_with_2(arguments, message, capsys):
    assert experiment.main(arguments) == 2
    assert message in capsys.readouterr().err


def test_several_configurations_and_overrides_in_any_place():
    line = ["a=1", "--config", "a.yaml", "--config", "b.yaml", "b=2", "--export", "prompt=-x --y"]
    args = options.parse_arguments(line)
    assert (args.config, args.stage, args.gpu) == (["a.yaml", "b.yaml"], "export", None)
    assert args.overrides == ["a=1", "b=2", "prompt=-x --y"]


def test_a_configuration_is_found_by_path_or_name(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "configs").mkdir()
    (tmp_path / "configs" / "mine.yaml").touch()
    (tmp_path / "other.yaml").touch()
    assert find_config("other.yaml") == Path("other.yaml")
    assert find_config("mine.yaml") == find_config("mine") == Path("configs/mine.yaml")
    # the shipped ones, from any folder
    assert find_config("demo.yaml").resolve() == ROOT / "configs" / "demo.yaml"
    for name, said in (("mien.yaml", ": did you mean 'mine.yaml'"), ("there/mine.yaml", "")):
        with pytest.raises(UserError, match=f"unknown configuration '{name}'{said}"):
            find_config(name)
    with pytest.raises(UserError, match="configuration 'a{200}': .*File name too long"):
        find_config(300 * "a")
    # an installed package brings its configurations
    (tmp_path / "package/configs").mkdir(parents=True)
    (tmp_path / "package/configs/demo.yaml").touch()
    monkeypatch.setattr(options, "__file__", str(tmp_path / "package/launch/options.py"))
    assert find_config("demo") == tmp_path / "package/configs/demo.yaml"


@pytest.mark.parametrize(
    ("environment", "gpu", "overrides", "visible"),
    [
        ({}, None, [], "0"),
        ({}, "1,2", [], "1,2"),
        ({}, "cpu", [], ""),
        ({"CUDA_VISIBLE_DEVICES": "3"}, None, [], "3"),
        ({"CUDA_VISIBLE_DEVICES": "3"}, "0", [], "3"),
        ({"CUDA_VISIBLE_DEVICES": "3"}, "cpu", [], ""),
        ({"CUDA_VISIBLE_DEVICES": ""}, None, [], ""),
        ({"LOCAL_WORLD_SIZE": "2"}, None, [], "0,1"),
        ({"SLURM_NTASKS_PER_NODE": "4(x2)"}, None, [], "0"),
        ({"SLURM_NTASKS_PER_NODE": "2"}, None, [], "0,1"),
        ({}, None, ["trainer.devices=3", "seed=1"], "0,1,2"),
        ({}, None, ["trainer.devices=x"], "0"),
    ],
)
def test_what_cuda_reports(monkeypatch, environment, gpu, overrides, visible):
    for name in ("CUDA_VISIBLE_DEVICES", "LOCAL_WORLD_SIZE", "SLURM_NTASKS_PER_NODE"):
        monkeypatch.delenv(name, raising=False)
    for name, value in environment.items():
        monkeypatch.setenv(name, value)
    choose_gpu(gpu, overrides)
    assert os.environ["CUDA_VISIBLE_DEVICES"] == visible


def test_gpus_that_are_none_or_not_there(monkeypatch, caplog):
    import torch

    for gpu in ("", "gpu", "0,", "-1", "0 1"):
        with pytest.raises(UserError, match="expected cpu, or numbers of GPUs"):
            choose_gpu(gpu)
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "0,1")
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 1)
    with pytest.raises(UserError, match="--gpu 0,1: torch .* can use 1 of these GPUs"):
        announce_device("0,1")
    assert announce_device(None) == 1
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "5")
    assert announce_device("0") == 1
    assert "--gpu 0 is ignored: CUDA_VISIBLE_DEVICES=5 is set" in caplog.text
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(UserError, match="--gpu 0: torch .* can use 0 .* run with --gpu cpu"):
        announce_device("0")
    assert announce_device("cpu") == announce_device(None) == 0
