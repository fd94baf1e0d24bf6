"""The drop-in inside an unmodified threestudio: all stages on its own launch.py, registry, base
classes, data module and savers; skipped without what ``tests/helpers/real_host.py`` needs.
"""

import os
import subprocess
from pathlib import Path

from tests.helpers.real_host import HARNESS, NEEDED, REPOSITORY, SHARED

from .test_extending import EXAMPLES, OVERRIDES

pytestmark = NEEDED

SMALL = [
    *(f"system.guidance.mesh={SHARED / 'assets' / 'spot.glb'}", "trainer.max_steps=3"),
    *("data.width=32", "data.height=32", "data.eval_width=32", "data.eval_height=32"),
    *("data.n_test_views=2", "system.geometry.prior.num_points=300"),
    *("system.geometry.grow.max_points=100", "system.evaluation.size=32"),
    "system.evaluation.views=2",
]


def try_extension(tmp_path: Path, config: Path, *overrides: str, parts: str = "") -> set[str]:
    """Run all stages, with a further extension in the folder ``parts``; return the files that they
    wrote.
    """
    paths = [str(REPOSITORY), os.environ.get("EXTRA_PYTHONPATH")]
    environment = {
        **os.environ,
        "STAGES": "train test export validate resume",
        "SCRATCH": str(tmp_path / "scratch"),
        "EXTRA_CUSTOM": parts,
        "EXTRA_PYTHONPATH": os.pathsep.join(filter(None, paths)),
    }
    drop_in = REPOSITORY / "custom" / "threestudio-gaussiandreamer"
    command = ["bash", str(HARNESS), str(drop_in), str(config), *overrides]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=1500)
    assert done.returncode == 0, done.stdout + done.stderr
    (run,) = (tmp_path / "scratch" / "outputs").glob("*/*")
    return {str(path.relative_to(run)) for path in run.rglob("*") if path.is_file()}


EXPECTED = {
    *("ckpts/last.ckpt", "save/it3-0.png", "save/it3-test.mp4", "save/it5-test.mp4"),
    "save/it3-export/gaussians.ply",
}


def test_our_configuration_with_our_data_module(tmp_path):
    assert try_extension(tmp_path, REPOSITORY / "configs" / "demo.yaml", *SMALL) >= EXPECTED


def test_our_configuration_with_the_data_module_and_background_of_the_host(tmp_path):
    lines = (REPOSITORY / "configs" / "demo.yaml").read_text().splitlines()
    kept = "\n".join(x for x in lines if "train_views" not in x and " background:" not in x)
    for ours, theirs in (
        ("gaussiandreamer-datamodule", "random-camera-datamodule"),
        ("gaussiandreamer-background", "solid-color-background"),
    ):
        kept = kept.replace(ours, theirs)
    (tmp_path / "host.yaml").write_text(kept)
    assert try_extension(tmp_path, tmp_path / "host.yaml", *SMALL) >= EXPECTED


def test_mock_guidance_with_a_regulariser_and_a_density_rule_of_another_extension(tmp_path):
    parts, names, options = tmp_path / "parts", ("relocate", "smooth"), []
    parts.mkdir()
    (parts / "__init__.py").write_text(f"from . import {', '.join(names)}\n")
    for name in names:
        text = next(text for key, text in EXAMPLES.items() if key.startswith(name))
        (parts / f"{name}.py").write_text(text)
        options += OVERRIDES[name]
    config = REPOSITORY / "configs" / "smoke.yaml"
    assert try_extension(tmp_path, config, *options, parts=str(parts)) >= {
        *("ckpts/last.ckpt", "save/it8-0.png", "save/it8-test.mp4"),
        *("save/it8-export/gaussians.ply", "save/it10-test.mp4"),
    }
