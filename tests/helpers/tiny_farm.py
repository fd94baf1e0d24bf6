"""A farm of a few guided assets that take seconds: a tiny Stable Diffusion scores the renders, and
a few Gaussians start from the bundled toy.
"""

import json
import os
import subprocess
import sys
from pathlib import Path

from tests.helpers import tiny_models

ROOT = Path(__file__).resolve().parents[2]
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


def write_farm(folder: Path, count: int, steps: int = 12) -> list[str]:
    """Write model, configuration and prompt list of a farm of ``count`` assets below ``folder``;
    return the arguments of the command but for ``--out``.
    """
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
    """Make one of the assets with the launcher in a process of its own; return its folder.

    It uses one thread, as the farm's workers do, since torch's results on a CPU depend on the
    number of threads. The embeddings aren't taken from the farm's cache.
    """
    command = [
        *(sys.executable, str(ROOT / "launch.py"), "--train", "--gpu", "cpu"),
        *("--config", "gaussiandreamer.yaml", "--config", str(folder / "tiny.yaml")),
        *(f"trainer.max_steps={steps}", f"seed={number}", f"exp_root_dir={folder / 'alone'}"),
        *("use_timestamp=false", f"tag=toy{number}", "name=alone"),
        f"system.prompt_processor.prompt=a toy number {number}",
        "system.prompt_processor.use_cache=false",
    ]
    environment = os.environ | {"OMP_NUM_THREADS": "1"}
    done = subprocess.run(command, capture_output=True, text=True, cwd=ROOT, env=environment)
    assert done.returncode == 0, done.stderr[-3000:]
    return folder / "alone" / "alone" / f"toy{number}"
