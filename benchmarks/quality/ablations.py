"""The paper's ablations and claims as tables, in dB against a known ground truth, on a CPU.

    python -m benchmarks.quality.ablations                          # the paper's ablations
    python -m benchmarks.quality.ablations --table faces            # prior against random start
                                                            under a view-blind score, five seeds
    python -m benchmarks.quality.ablations --table guidance         # guidance scale 100: plain,
                                                            annealed, clipped
    python -m benchmarks.quality.ablations --mesh spot.glb --seeds 0 1 2 --size 128

Each row is a run of the base recipe (`recipe.py`) with a few options changed. Its score is the
PSNR on held-out views that no bank holds. `view-exact` knows the picture from every camera: an
upper bound, reconstruction. `view-blind` knows only pictures from anywhere, in a low-dimensional
linear latent, as a real diffusion model does: that is where a prior matters. Neither says anything
about the quality of a real diffusion model."""

import argparse
import csv
import json
import platform
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import yaml

from benchmarks.quality.recipe import recipe

ROOT = Path(__file__).resolve().parents[2]
RANDOM_START = {
    "system.geometry.prior_type": "random-prior",
    "system.geometry.prior": {"num_points": 10000, "shape": "sphere"},
    "system.geometry.grow.enabled": False,
}
# One distance for cameras and bank: otherwise nearer views are further modes of the mixture, and
# their zoom hides the effect of the faces.
VIEW_BLIND = {
    "system.guidance.mode": "view-agnostic",
    "system.guidance.space": "latent",
    "system.guidance.latent_size": 16,
    "system.guidance.bank_views": 500,
    "data.camera_distance_range": [2.5, 2.5],
    "data.fovy_range": [50, 50],
    "system.guidance.bank_distance_range": [2.5, 2.5],
    "system.guidance.bank_fovy_range": [50.0, 50.0],
}
NO_ANNEALING = {"system.guidance.max_step_percent": 0.98}
LATENT = {"system.guidance.space": "latent", "system.guidance.latent_size": 16}
STRONG = {"system.guidance.guidance_scale": 101.0}  # threestudio's 100
CLIPPED = {"system.guidance.grad_clip": [0, 1.5, 2.0, 1000]}
PAPER_RATES = {
    f"system.geometry.lr_{name}": rate
    for name, rate in (
        ("means", 5e-5),
        ("scales", 1e-3),
        ("quats", 1e-2),
        ("opacities", 1e-2),
        ("sh", 1.25e-2),
    )
}

# Options replace the recipe's values under their keys, whole sections included.
TABLES = {
    "ablations": {
        "default": {},
        "random start": RANDOM_START,
        "no growing": {"system.geometry.grow.enabled": False},
        "no perturbation": {"system.geometry.grow.color_range": [0.0, 0.0]},
        "radius 0.0025": {"system.geometry.grow.radius": 0.0025},
        "radius 0.01": {"system.geometry.grow.radius": 0.01},
        "radius 0.025": {"system.geometry.grow.radius": 0.025},
        "no schedule": NO_ANNEALING,
        "the paper's rates": PAPER_RATES,
    },
    "faces": {"prior": {}, "random start": RANDOM_START},
    "guidance": {
        "scale 1": LATENT,
        "scale 100": LATENT | STRONG | NO_ANNEALING,
        "scale 100, annealed": LATENT | STRONG,
        "scale 100, annealed, clipped": LATENT | STRONG | CLIPPED,
    },
}
SCORES = {
    "ablations": ("view-exact", "view-blind"),
    "faces": ("view-blind",),
    "guidance": ("view-exact",),
}


def main() -> None:
    arguments = parse_arguments()
    rows = []
    for variant, overrides in TABLES[arguments.table].items():
        for score in SCORES[arguments.table]:
            guidance = VIEW_BLIND if score == "view-blind" else {}
            runs = [run(arguments, seed, guidance | overrides) for seed in arguments.seeds]
            rows.append(summary(variant, score, runs))
            print_row(rows[-1])
    write(arguments, rows)


def parse_arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--table", choices=TABLES, default="ablations")
    parser.add_argument("--mesh", default="", help="another object than the bundled one")
    parser.add_argument("--seeds", type=int, nargs="+", help="default: 0, or 0 to 4 for faces")
    parser.add_argument(
        "--size", type=int, default=128, help="width and height of the training renders"
    )
    parser.add_argument("--steps", type=int, default=1200)
    parser.add_argument(
        "--out", type=Path, help="CSV file; default: benchmarks/results/<table>.csv"
    )
    parser.add_argument("overrides", nargs="*", help="more key=value options for every run")
    arguments = parser.parse_args()
    arguments.seeds = arguments.seeds or (list(range(5)) if arguments.table == "faces" else [0])
    return arguments


def run(arguments: argparse.Namespace, seed: int, options: dict[str, Any]) -> dict:
    """Run one training in a process of its own; return its metrics."""
    size, steps = arguments.size, arguments.steps
    common = {
        "name": "run", "tag": "run", "use_timestamp": False, "seed": seed, "data.width": size,
        "data.height": size, "system.evaluation.size": size, "data.n_test_views": 2,
        "data.eval_width": 64, "data.eval_height": 64, "trainer.max_steps": steps,
        "trainer.val_check_interval": steps, "trainer.enable_progress_bar": False,
        "system.guidance.bank_seed": seed, "system.guidance.image_size": size,
    }  # fmt: skip
    mesh = {"system.guidance.mesh": arguments.mesh} if arguments.mesh else {}
    with tempfile.TemporaryDirectory() as folder:
        cfg = changed_recipe({**common, **mesh, **options, "exp_root_dir": folder})
        path = Path(folder) / "run.yaml"
        path.write_text(yaml.safe_dump(cfg))
        command = [
            sys.executable,
            str(ROOT / "launch.py"),
            "--config",
            str(path),
            "--train",
            *arguments.overrides,
        ]
        finished = subprocess.run(command, capture_output=True, text=True, cwd=ROOT)
        if finished.returncode:
            sys.exit(f"a run failed ({finished.returncode}): {options}\n{finished.stderr[-3000:]}")
        return json.loads((Path(folder) / "run/run/save/metrics.json").read_text())


def changed_recipe(options: dict[str, Any]) -> dict:
    """Return the recipe with each dotted key replaced."""
    cfg = recipe()
    for dotted, value in options.items():
        *sections, key = dotted.split(".")
        section = cfg
        for name in sections:
            section = section[name]
        section[key] = value
    return cfg


def summary(variant: str, score: str, runs: list[dict]) -> dict:
    values = {
        key: [r["result"][key] for r in runs]
        for key in ("psnr", "ssim", "multi_face", "gaussians", "seconds")
    }
    return {
        "variant": variant,
        "score": score,
        "seeds": len(runs),
        "start_psnr": statistics.median(r["prior"]["psnr"] for r in runs),
        **{key: statistics.median(v) for key, v in values.items()},
        "psnr_min": min(values["psnr"]),
        "psnr_max": max(values["psnr"]),
    }


def print_row(row: dict) -> None:
    spread = f" ({row['psnr_min']:.2f}..{row['psnr_max']:.2f})" if row["seeds"] > 1 else ""
    print(
        f"{row['variant']:<30}{row['score']:<12}{row['start_psnr']:6.2f} -> {row['psnr']:6.2f} "
        f"dB{spread}  SSIM {row['ssim']:.3f}"
        f"  multi-face {100 * row['multi_face']:3.0f} %  {row['gaussians']:.0f} Gaussians  "
        f"{row['seconds']:.0f} s",
        flush=True,
    )


def write(arguments: argparse.Namespace, rows: list[dict]) -> None:
    path = arguments.out or ROOT / f"benchmarks/results/{arguments.table}.csv"
    path.parent.mkdir(parents=True, exist_ok=True)
    commit = subprocess.run(
        ["git", "rev-parse", "--short", "HEAD"], capture_output=True, text=True, cwd=ROOT
    ).stdout.strip()
    about = ", ".join(
        [
            platform.machine(),
            f"commit {commit or 'unknown'}",
            time.strftime("%Y-%m-%d"),
            *sys.argv[1:],
        ]
    )
    with open(path, "w", newline="") as file:
        file.write(f"# {about}\n")
        writer = csv.DictWriter(file, fieldnames=rows[0])
        writer.writeheader()
        writer.writerows(rows)
    print(f"\n{path}")


if __name__ == "__main__":
    main()
