"""Several processes that train one cloud: how many there are, and what they make."""

import json
import os
import socket
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from tests.helpers.gallery import files
from tests.training import runs
from threestudio_gaussiandreamer.core import launcher
from threestudio_gaussiandreamer.core.command import run_main
from threestudio_gaussiandreamer.core.errors import UserError
from threestudio_gaussiandreamer.core.launcher import require_launcher, train_alone
from threestudio_gaussiandreamer.launch import ddp, experiment
from threestudio_gaussiandreamer.launch.ddp import Processes, planned_processes, trainer_options

ROOT = Path(__file__).parents[2]
TOLERANCE = 0.01
"""Largest difference of the dB of runs with different numbers of processes."""
TORCHRUN = {"TORCHELASTIC_RUN_ID": "1", "WORLD_SIZE": "4", "LOCAL_WORLD_SIZE": "2"}
SLURM = {"SLURM_NTASKS": "4", "SLURM_NNODES": "2", "SLURM_JOB_NAME": "train"}


@pytest.fixture
def environment(monkeypatch):
    """Sets the variables of a launcher; without a call there is none."""
    for name in ["TORCHELASTIC_RUN_ID", "SLURM_JOB_NAME", *launcher.INDICES, *launcher.SIZES]:
        monkeypatch.delenv(name, raising=False)

    def launched_by(variables):
        for name, value in variables.items():
            monkeypatch.setenv(name, value)

    return launched_by


def plugins(processes):
    return trainer_options(processes).get("plugins")


@pytest.mark.parametrize(
    ("variables", "n_gpus", "trainer", "expected"),
    [
        ({}, 0, {}, (1, 1)),
        ({}, 2, {}, (2, 1)),
        ({}, 2, {"devices": 1}, (1, 1)),
        ({}, 0, {"devices": 3}, (3, 1)),
        ({}, 2, {"num_nodes": 2}, (2, 2)),
        (TORCHRUN, 0, {}, (2, 2)),
        (TORCHRUN, 4, {"devices": 2, "num_nodes": 2}, (2, 2)),
        (SLURM, 2, {}, (2, 2)),
        (SLURM | {"SLURM_NTASKS": "1", "SLURM_NNODES": "1"}, 2, {}, (2, 1)),
        (SLURM | {"SLURM_JOB_NAME": "bash"}, 0, {}, (1, 1)),
        ({}, 0, {"devices": 0}, "trainer.devices: expected a whole number from 1 on, got 0"),
        ({}, 0, {"devices": "auto"}, "trainer.devices: expected .* got 'auto'"),
        ({}, 0, {"devices": True}, "trainer.devices: expected .* got True"),
        ({}, 0, {"num_nodes": 1.5}, "trainer.num_nodes: expected .* got 1.5"),
        ({}, 1, {"devices": 2}, "2 processes on a machine need as many GPUs, and 1 can be seen"),
        (TORCHRUN, 0, {"devices": 3}, "trainer.devices is 3, but torchrun has started 2 x 2"),
        (SLURM, 0, {"num_nodes": 1}, "trainer.num_nodes is 1, but SLURM has started 2 x 2"),
    ],
)
def test_how_many_processes_train(environment, variables, n_gpus, trainer, expected):
    """Or what contradicts what; a worker of a farm trains alone."""
    environment(variables)
    if isinstance(expected, str):
        with pytest.raises(UserError, match=expected):
            planned_processes(n_gpus, trainer)
    else:
        assert planned_processes(n_gpus, trainer)[:2] == expected
    train_alone()
    assert planned_processes(0, {}) == Processes(1, 1)


def test_a_shell_of_slurm_trains_with_one_process_and_says_so(environment, caplog):
    environment(SLURM | {"SLURM_JOB_NAME": "interactive"})
    require_launcher()
    found = planned_processes(0, {})
    assert found == Processes(1, 1) and plugins(found) is None
    assert "SLURM has 4 tasks, which a shell (SLURM_JOB_NAME=interactive) doesn't" in caplog.text
    assert "the number of processes that train is 1; for all: srun --job-name" in caplog.text
    # a batch job with one task needs none of srun's variables
    environment({"SLURM_JOB_NAME": "train", "SLURM_NTASKS": "1", "SLURM_NNODES": "1"})
    require_launcher()
    assert plugins(planned_processes(0, {}))
    environment(dict.fromkeys(launcher.SLURM, "0"))
    assert plugins(planned_processes(0, {})) is None


@pytest.mark.parametrize("name", [*launcher.INDICES, *launcher.SIZES])
def test_a_variable_that_is_no_number_is_named(name):
    for value in ("x", "", "-1", "1.5"):
        said = f"variable {name} is '{value}'; expected a whole number"
        with pytest.raises(UserError, match=said):
            require_launcher({name: value})


RANKS = {"RANK": "1", "LOCAL_RANK": "1"}
TASK = dict.fromkeys(launcher.SLURM, "1")


@pytest.mark.parametrize(
    ("variables", "said"),
    [
        (SLURM, "SLURM_NTASKS is set, but not SLURM_PROCID, SLURM_LOCALID, SLURM_NODEID: start"),
        (SLURM | {k: "0" for k in TASK if k != "SLURM_NODEID"}, "set, but not SLURM_NODEID: start"),
        (TORCHRUN, "TORCHELASTIC_RUN_ID is set, but not RANK, LOCAL_RANK: start .* with torchrun"),
        ({"TORCHELASTIC_RUN_ID": "1"}, "not RANK, LOCAL_RANK, WORLD_SIZE, LOCAL_WORLD_SIZE: "),
        (TORCHRUN | RANKS | {"WORLD_SIZE": "3"}, "WORLD_SIZE is 3, no multiple of LOCAL_WORLD_"),
        (TASK | SLURM | {"SLURM_NTASKS": "3"}, "SLURM_NTASKS is 3, no multiple of SLURM_NNODES"),
        ({"RANK": "1", "WORLD_SIZE": "2"}, "RANK is 1, but nothing says how many .* torchrun"),
        (TASK | SLURM | {"SLURM_JOB_NAME": "bash"}, "SLURM_PROCID is 1, but nothing says"),
        ({"SLURM_NTASKS": "0"}, "SLURM_NTASKS is '0'; expected a whole number from 1 on"),
        *((variables, None) for variables in ({}, TORCHRUN | RANKS, SLURM | TASK)),
        # as Lightning starts its second process
        ({"LOCAL_RANK": "1", "NODE_RANK": "0", "WORLD_SIZE": "2"}, None),
    ],
)
def test_what_is_missing_beside_a_variable_is_named(variables, said):
    if said is None:
        return require_launcher(variables)
    with pytest.raises(UserError, match=said):
        require_launcher(variables)


def test_a_broken_variable_is_one_line_before_a_command_is_imported(monkeypatch, capsys):
    monkeypatch.setenv("LOCAL_RANK", "x")
    train = ["--config", "demo.yaml", "--train", "--gpu", "cpu"]
    for command in (lambda: experiment.main(train), lambda: run_main("nothing.of.this.name")):
        assert command() == 2
        said = capsys.readouterr().err
        assert said.startswith("error: the environment variable LOCAL_") and said.count("\n") == 1


def test_strategy_and_plugins_of_the_trainer(environment):
    """Lightning starts the processes in a job with one task; a single one needs no strategy."""
    assert trainer_options(Processes(1, 1)) == {"devices": 1, "num_nodes": 1}
    strategy = trainer_options(Processes(2, 2))["strategy"]
    assert isinstance(strategy, ddp.ReplicatedStrategy) and strategy._timeout == ddp.LONGEST_WAIT
    assert plugins(Processes(2, 1)) is None
    environment(SLURM | {"SLURM_NTASKS": "1"} | dict.fromkeys(launcher.SLURM, "0"))
    (plugin,) = plugins(planned_processes(2, {}))
    assert not plugin.creates_processes_externally
    assert plugins(Processes(2, 1, "SLURM")) is plugins(Processes(1, 1)) is None


def raised(error, module):
    """Return the error as raised by a function of a module of this name."""
    try:
        exec("raise error", {"__name__": module, "error": error})
    except Exception as caught:
        return caught


@pytest.mark.parametrize(
    ("error", "module", "active", "lost"),
    [
        (RuntimeError("Connection closed by peer"), "torch.distributed.c10d", True, True),
        (RuntimeError("writev: Broken pipe"), "torch.distributed.c10d", True, True),
        (RuntimeError("Connection closed by peer"), "torch.distributed.c10d", False, False),
        (RuntimeError("shapes differ"), "torch.distributed.c10d", True, False),
        (RuntimeError("CUDA error: the launch timed out"), "torch.cuda", True, False),
        (UserError("with a network connection: download it"), "ours.hub", True, False),
    ],
)
def test_which_errors_mean_a_lost_process(monkeypatch, error, module, active, lost):
    monkeypatch.setattr(ddp, "is_active", lambda: active)
    assert ddp.is_lost_process(raised(error, module)) == lost


CHANGES = [*runs.DENSIFY, *runs.PRUNE, "data.batch_size=4"]
# without it Adam's first steps would magnify the rounding of gradients that are zero
CHANGES.append("system.optimizer.args.eps=1.0e-3")


@pytest.fixture(scope="module")
def mesh(tmp_path_factory):
    import trimesh

    path = tmp_path_factory.mktemp("mesh") / "box.glb"
    trimesh.creation.box().export(path)
    return path


@pytest.fixture(scope="module")
def alone(mesh, tmp_path_factory):
    """The folder of a run of six steps in one process."""
    folder = tmp_path_factory.mktemp("alone")
    assert runs.launch(folder, mesh, *CHANGES, "trainer.max_steps=6") == 0
    return runs.run_folder(folder)


def command(folder, mesh, *options, launcher=()):
    """Return the command line of a run on the CPU."""
    paths = [f"exp_root_dir={folder}", f"system.guidance.mesh={mesh}"]
    config = ["--config", str(runs.CONFIGS / "demo.yaml"), "--train", "--gpu", "cpu"]
    program = [sys.executable, *launcher, str(ROOT / "launch.py")]
    return [*program, *config, *paths, *runs.SMALL, *CHANGES, *options]


def started(folder, line, **variables):
    environment = os.environ | {"PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"} | variables
    output = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT, "text": True}
    return subprocess.Popen(line, cwd=folder, env=environment, **output)


def require_success(*processes):
    said = [process.communicate(timeout=900)[0] for process in processes]
    for process, text in zip(processes, said, strict=True):
        assert process.returncode == 0, text[-3000:]
    return said


def free_port():
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return str(probe.getsockname()[1])


def two_tasks(folder, line):
    """Start a command as SLURM's two tasks, on a machine each."""
    job = SLURM | {"SLURM_NTASKS": "2", "SLURM_NTASKS_PER_NODE": "1", "SLURM_JOB_ID": "7"}
    job |= {"MASTER_PORT": free_port(), "MASTER_ADDR": "127.0.0.1"}
    ranks = ({"SLURM_PROCID": r, "SLURM_NODEID": r, "SLURM_LOCALID": "0"} for r in "01")
    return [started(folder, line, **job, **rank) for rank in ranks]


def require_same_training(ours, theirs):
    """Compare two results: as many Gaussians, of the same quality but for the order of sums."""
    one, other = (runs.cloud_of(folder / "ckpts" / "last.ckpt") for folder in (ours, theirs))
    assert {n: v.shape for n, v in one.items()} == {n: v.shape for n, v in other.items()}
    scores = (json.loads((folder / "save/metrics.json").read_text()) for folder in (ours, theirs))
    found, expected = ([s["prior"]["psnr"], s["result"]["psnr"]] for s in scores)
    assert found == pytest.approx(expected, abs=TOLERANCE)


@pytest.mark.slow
def test_two_processes_of_lightning_and_a_resumed_run_with_one(alone, mesh, tmp_path):
    two = command(tmp_path, mesh, "trainer.devices=2", "trainer.max_steps=3")
    (said,) = require_success(started(tmp_path, two))
    assert said.count("the run at a glance") == 1
    ckpt = runs.run_folder(tmp_path) / "ckpts" / "last.ckpt"
    assert torch.load(ckpt, weights_only=True)["global_step"] == 3
    options = [*CHANGES, "trainer.max_steps=6", f"resume={ckpt}"]
    assert runs.launch(tmp_path, mesh, *options) == 0
    require_same_training(runs.run_folder(tmp_path), alone)


@pytest.mark.slow
def test_four_processes_of_torchrun_on_two_machines(alone, mesh, tmp_path):
    port = ["--master-addr=127.0.0.1", f"--master-port={free_port()}"]
    module = ["-m", "torch.distributed.run", "--nnodes=2", "--nproc-per-node=2", *port]
    nodes = ([*module, f"--node-rank={rank}"] for rank in (0, 1))
    lines = [command(tmp_path, mesh, "trainer.max_steps=6", launcher=node) for node in nodes]
    require_success(*(started(tmp_path, line) for line in lines))
    run = runs.run_folder(tmp_path)
    require_same_training(run, alone)
    assert written(run) == written(alone)
    assert (run / "cmd.txt").read_text().count("\n") == 1


def written(folder):
    """The files of a run but for TensorBoard's, whose names have the time, and the sources."""
    return {name for name in files(folder) if not name.startswith(("tb_logs", "code"))}


DIES = """
import os
from threestudio_gaussiandreamer.training.system import GaussianDreamerSystem

def step(self, batch, index, train=GaussianDreamerSystem.training_step):
    if os.environ["SLURM_PROCID"] == "1" and self.global_step == 2:
        os.kill(os.getpid(), 9)
    return train(self, batch, index)

GaussianDreamerSystem.training_step = step
"""
"""An extension that kills the second process in its third step."""


@pytest.mark.slow
def test_a_process_that_has_lost_another_one_says_so(mesh, tmp_path):
    """Two tasks of SLURM, since Lightning kills the processes that it has started itself."""
    extension = tmp_path / "custom" / "dies"
    extension.mkdir(parents=True)
    (extension / "__init__.py").write_text(DIES)
    first, second = two_tasks(tmp_path, command(tmp_path, mesh, "trainer.max_steps=6"))
    try:
        said = first.communicate(timeout=300)[0]
        assert first.returncode == 2, said[-3000:]
        assert "another process of this run has ended" in said and "Traceback" not in said
        assert second.wait(timeout=60) == -9
    finally:
        first.kill(), second.kill()
