"""Whole farms of tiny guided assets on Ray, against single runs."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from tests.helpers import tiny_models
from threestudio_gaussiandreamer.farm.worker import digest

pytest.importorskip("ray", reason="Ray isn't installed: pip install -e .[cluster]")
pytestmark = pytest.mark.slow
ROOT = Path(__file__).resolve().parents[2]
COUNT, STEPS = 3, 60
SECONDS = 300
CONFIG = """
# laid over gaussiandreamer.yaml
name: tiny-guided
data: {width: 64, height: 64, eval_width: 32, eval_height: 32, batch_size: 2, n_test_views: 2,
  n_val_views: 1}
system:
  geometry:
    prior_type: mesh-prior
    prior: {path: toy.glb, num_points: 200, color_smoothing: 0}
    grow: {num_candidates: 500, max_points: 100}
    lr_means: 1.0e-3
    lr_sh: 2.0e-2
  renderer: {downsample: 1}
  guidance:
    pretrained_model_name_or_path: MODEL
    half_precision_weights: false
  prompt_processor: {cache_dir: CACHE}
  exporter: {save_video: false, formats: [ply, spz]}
trainer: {max_steps: 12, val_check_interval: 1000, enable_progress_bar: false}
checkpoint: {save_top_k: 1, every_n_train_steps: 3}
"""
HANGS_ONCE = """
import time
from pathlib import Path
from threestudio_gaussiandreamer.host import register
from threestudio_gaussiandreamer.priors.mesh import MeshPrior

@register("hanging-prior")
class HangingPrior(MeshPrior):
    def generate(self, prompt, generator):
        if not Path("has_hung").exists():
            Path("has_hung").touch()
            time.sleep(1000)
        return super().generate(prompt, generator)
"""


def write_farm(folder: Path, count: int, steps: int = 12) -> list[str]:
    """Write a farm of ``count`` assets; return the arguments of the command but ``--out``."""
    model = folder / "model"
    if not model.is_dir():
        tiny_models.stable_diffusion(model)
    text = CONFIG.replace("MODEL", str(model)).replace("CACHE", str(folder / "embeddings"))
    (folder / "tiny.yaml").write_text(text)
    rows = [{"prompt": f"a toy number {i}", "name": f"toy{i}", "seed": i} for i in range(count)]
    (folder / "prompts.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    configs = ["--config", "gaussiandreamer.yaml", "--config", str(folder / "tiny.yaml")]
    return [str(folder / "prompts.jsonl"), *configs, f"trainer.max_steps={steps}"]


def make_alone(folder: Path, number: int, steps: int = 12) -> Path:
    """Make an asset with the launcher, without cached embeddings; return its folder."""
    command = [
        *(sys.executable, str(ROOT / "launch.py"), "--train", "--gpu", "cpu"),
        *("--config", "gaussiandreamer.yaml", "--config", str(folder / "tiny.yaml")),
        *(f"trainer.max_steps={steps}", f"seed={number}", f"exp_root_dir={folder / 'alone'}"),
        *("use_timestamp=false", f"tag=toy{number}", "name=alone"),
        f"system.prompt_processor.prompt=a toy number {number}",
        "system.prompt_processor.use_cache=false",
    ]
    environment = os.environ | {"OMP_NUM_THREADS": "1"}  # as the workers: results depend on it
    done = subprocess.run(command, capture_output=True, text=True, cwd=ROOT, env=environment)
    assert done.returncode == 0, done.stderr[-3000:]
    return folder / "alone" / "alone" / f"toy{number}"


class Farm:
    """The command in a process of its own, in the folder ``start``."""

    def __init__(self, folder, arguments, start=ROOT):
        self.out, self.place = folder / "farm", start
        command = [sys.executable, "-m", "threestudio_gaussiandreamer.farm", *arguments]
        self.command = [*command, "--out", str(self.out), "--gpus", "0", "--workers", "2"]

    def start(self, *more, cluster="", **environment):
        command = [*self.command, *(["--address", cluster] if cluster else []), *more]
        environment = {**os.environ, "PYTHONPATH": str(ROOT), **environment}
        output = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT, "text": True}
        return subprocess.Popen(command, cwd=self.place, env=environment, **output)

    def run(self, *more, **options):
        process = self.start(*more, **options)
        said, _ = process.communicate(timeout=SECONDS)
        return process.returncode, said

    def records(self, file="result.json"):
        paths = sorted(self.out.glob(f"assets/*/{file}"))
        return {path.parent.name: json.loads(path.read_text()) for path in paths}

    def checkpointed(self):
        """The assets that have a checkpoint and aren't finished."""
        found = {path.parents[1] for path in self.out.glob("assets/*/ckpts/*.ckpt")}
        return [folder for folder in found if not (folder / "result.json").exists()]


def wait_for(condition, process):
    deadline = time.monotonic() + SECONDS
    while not (found := condition()):
        assert process.poll() is None and time.monotonic() < deadline, process.stdout.read()
        time.sleep(0.02)
    return found


@pytest.fixture(scope="module")
def cluster():
    """The address of a cluster on this machine, which serves all farms but one."""
    import ray

    options = {"include_dashboard": False, "log_to_driver": False, "logging_level": "ERROR"}
    context = ray.init("local", num_cpus=2, object_store_memory=100 << 20, **options)
    yield context.address_info["gcs_address"]
    ray.shutdown()


@pytest.fixture(scope="module")
def made(tmp_path_factory, cluster):
    """A farm whose worker and driver were killed, and which was then left alone."""
    folder = tmp_path_factory.mktemp("farm")
    farm = Farm(folder, write_farm(folder, COUNT, STEPS))
    process = farm.start(cluster=cluster)
    asset = wait_for(farm.checkpointed, process)[0]
    worker = int((asset / "attempts.txt").read_text().split()[-1])
    os.kill(worker, signal.SIGKILL)
    wait_for(lambda: len((asset / "attempts.txt").read_text().splitlines()) == 2, process)
    process.kill()
    process.communicate()
    proxies = ("http_proxy", "https_proxy", "all_proxy", "grpc_proxy")
    environment = dict.fromkeys(proxies, "http://127.0.0.1:9") | {"no_proxy": ""}
    environment["TMPDIR"] = str(folder / ("x" * 90))
    Path(environment["TMPDIR"]).mkdir()
    code, said = farm.run(**environment)
    assert code == 0 and f"{COUNT} finished, 0 failed" in said, said
    return farm


def test_a_killed_worker_goes_on_and_the_assets_are_those_of_single_runs_to_the_bit(made):
    logs = [path.read_text() for path in made.out.glob("assets/*/log.txt")]
    assert any("resume=auto: resuming from" in log for log in logs)
    results = made.records()
    assert list(results) == [f"toy{i}" for i in range(COUNT)] and not made.records("failed.json")
    for result in results.values():
        assert set(result["loads"].values()) == {1} and "unet" in result["loads"]
    name, result = max(results.items(), key=lambda item: item[1]["attempts"])
    alone = make_alone(made.out.parent, int(name.removeprefix("toy")), STEPS)
    assert result["hash"] == digest(alone) == digest(made.out / "assets" / name)


def test_ctrl_c_leaves_checkpoints_and_a_failed_asset_is_reported(tmp_path, cluster):
    farm = Farm(tmp_path, write_farm(tmp_path, 1, 100_000))
    rows = [{"prompt": "a toy", "name": "long", "seed": 1}]
    rows.append({"prompt": "b", "name": "fails", "overrides": "system.geometry.prior.path=no.glb"})
    (tmp_path / "prompts.jsonl").write_text("\n".join(map(json.dumps, rows)))
    process = farm.start(cluster=cluster)
    wait_for(lambda: any(folder.name == "long" for folder in farm.checkpointed()), process)
    process.send_signal(signal.SIGINT)
    said, _ = process.communicate(timeout=SECONDS)
    assert process.returncode == 130, said
    assert "stopped at step" in (farm.out / "assets/long/log.txt").read_text()
    failed = farm.records("failed.json")
    assert failed["long"]["state"] == "stopped" and failed["long"]["worker_seconds"] > 0
    assert failed["fails"]["state"] == "failed" and "no.glb" in failed["fails"]["error"]
    assert "system.geometry.prior.path=no.glb" in failed["fails"]["command"]


def test_an_asset_that_hangs_is_made_again(tmp_path, cluster):
    (tmp_path / "custom").mkdir()
    (tmp_path / "custom/hanging.py").write_text(HANGS_ONCE)
    arguments = [*write_farm(tmp_path, 1), "system.geometry.prior_type=hanging-prior"]
    farm = Farm(tmp_path, arguments, start=tmp_path)
    code, said = farm.run("--time-limit", "20", "--retries", "9", cluster=cluster)
    assert code == 0 and "toy0: restarted: no step for" in said, said
    assert farm.records()["toy0"]["attempts"] >= 2
    assert farm.records()["toy0"]["worker_seconds"] > 20
