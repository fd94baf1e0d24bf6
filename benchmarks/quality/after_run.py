"""Pruning after the run: rankings, and the effect of rounds and recovery, in dB to the unpruned
cloud on test views.

    python -m benchmarks.quality.after_run                                       # the toy, one
                                                                         seed
    python -m benchmarks.quality.after_run --objects toy.glb spot.glb duck.glb --seeds 0 1 2

A cloud of 10,000, trained as the demo is at 128^2 on one thread (`runs.py`), is pruned to a count
in one shot; in one shot with as many recovery steps as all rounds together; and in rounds, like the
prune command, with its ranking and others. Results go to docs/charts/after_run.csv."""

import statistics
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from benchmarks.quality import runs
from benchmarks.quality.jobs import NO_BUDGET, STEPS_A_ROUND
from threestudio_gaussiandreamer import register_parts
from threestudio_gaussiandreamer.formats.gaussian_files import read_cloud
from threestudio_gaussiandreamer.gaussians import importance
from threestudio_gaussiandreamer.gaussians.gaussians import Gaussians
from threestudio_gaussiandreamer.gaussians.recover import Recovery, recover
from threestudio_gaussiandreamer.gaussians.simplify import (
    Budget,
    keep_best,
    rounds_to,
    simplify,
    view_importance,
)
from threestudio_gaussiandreamer.gaussians.views import Views, draw, psnr_to_original, render_all
from threestudio_gaussiandreamer.host import get_device
from threestudio_gaussiandreamer.prune import PruneOptions
from threestudio_gaussiandreamer.prune.pipeline import views_of

COUNTS = (2500, 1500)
DRAWN = PruneOptions(size=runs.SIZE, eps2d=runs.RENDERER["eps2d"])
"""Options of the renderer that the cloud was trained with."""
COLUMNS = "variant,x,object,seed,psnr,machine,commit".split(",")


def main() -> None:
    arguments = runs.argument_parser(__doc__).parse_args()
    runs.require_kernel()
    register_parts()
    runs.measure_missing("after_run", COLUMNS, arguments, measured)
    print(table())


def measured(mesh: str, seed: int) -> list[dict[str, Any]]:
    """Return the rows of the CSV: method, number of Gaussians and dB."""
    with tempfile.TemporaryDirectory() as folder:
        stored = read_cloud(
            str(
                runs.train(Path(folder), mesh, seed, NO_BUDGET)
                / f"it{runs.STEPS}-export/gaussians.ply"
            )
        )
    cloud = stored.gaussians.tensors(get_device())
    train_views, val_views, tests = views_of(stored, DRAWN)
    pictures = render_all(cloud, tests)
    place = {"object": runs.object_name(mesh), "seed": seed}
    return [
        place
        | {
            "variant": variant,
            "x": count,
            "psnr": round(psnr_to_original(fewer, tests, pictures), 3),
        }
        for count in COUNTS
        for variant, fewer in variants(cloud, count, train_views, val_views)
    ]


def variants(
    cloud: Gaussians, count: int, train_views: Views, val_views: Views
) -> Iterator[tuple[str, Gaussians]]:
    """Yield each way from a cloud to ``count`` Gaussians, and its result."""
    for name in importance.SCORES:
        yield f"one shot, by {name}", keep_best(cloud, RANKS[name](cloud, train_views, 0), count)
    steps = STEPS_A_ROUND * rounds_to(count, len(cloud.means))
    yield (
        "one shot, by removal, recovered",
        recover(
            keep_best(cloud, view_importance(cloud, train_views), count),
            train_views,
            render_all(cloud, train_views),
            steps,
            0,
        ),
    )
    for name in importance.SCORES:
        yield (
            f"in rounds, by {name}",
            simplify(
                cloud,
                Budget(count=count),
                Recovery(cloud, train_views, val_views, steps=STEPS_A_ROUND),
                rank=RANKS[name],
            ),
        )


@torch.no_grad()
def contribution(cloud: Gaussians, views: Views, seed: int) -> Tensor:
    """Return the largest weight in any pixel."""
    return draw(cloud, views, torch.arange(len(views.viewmats)))[1].amax(0)


RANKS = {
    "removal": view_importance,
    "contribution": contribution,
    "opacity": lambda cloud, views, seed: cloud.logit_opacities.detach(),
    "random": lambda cloud, views, seed: torch.rand(
        len(cloud.means), generator=torch.Generator().manual_seed(seed)
    ),
}


def table() -> str:
    """Return the medians over the seeds as Markdown."""
    rows = runs.rows_of("after_run")
    objects = list(dict.fromkeys(row["object"] for row in rows))
    lines = [f"| to | {' | '.join(objects)} |", f"| --- |{' ---: |' * len(objects)}"]
    for variant, count in dict.fromkeys((row["variant"], row["x"]) for row in rows):
        same = [row for row in rows if (row["variant"], row["x"]) == (variant, count)]
        values = [
            statistics.median(float(row["psnr"]) for row in same if row["object"] == name)
            for name in objects
        ]
        lines.append(f"| {count}, {variant} | {' | '.join(f'{value:.1f}' for value in values)} |")
    return "\n".join(lines)


if __name__ == "__main__":
    sys.exit(main())
