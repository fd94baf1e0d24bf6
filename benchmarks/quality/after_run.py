"""After the run: what ranks best, and what rounds and recovery buy, in dB to the unpruned cloud on
views that nothing was fitted to.

    python -m benchmarks.quality.after_run                                       # the toy, one
                                                                         seed: three minutes
    python -m benchmarks.quality.after_run --objects toy.glb spot.glb duck.glb --seeds 0 1 2

A cloud of 10,000, trained as the demo is at 128^2 on one thread (`runs.py`), goes to a count in one
shot; in one shot and as many steps of recovery as the rounds have together; and in rounds, as the
prune command does it, ranked as it does and otherwise. Results go to docs/charts/after_run.csv."""

import argparse
import statistics
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from benchmarks.quality.jobs import NO_BUDGET, STEPS_A_ROUND
from benchmarks.quality.runs import (
    RENDERER,
    SIZE,
    STEPS,
    append_rows,
    measured_in,
    object_name,
    rows_of,
    train,
)
from threestudio_gaussiandreamer import register_parts
from threestudio_gaussiandreamer.formats.gaussian_files import read_cloud
from threestudio_gaussiandreamer.gaussians import importance as parsimony
from threestudio_gaussiandreamer.gaussians.gaussians import Gaussians
from threestudio_gaussiandreamer.gaussians.simplify import (
    Budget,
    Views,
    draw,
    likeness,
    look,
    only,
    recover,
    rounds_to,
    simplify,
    worth,
)
from threestudio_gaussiandreamer.prune import command as prune

COUNTS = (2500, 1500)
DRAWN = prune.PruneOptions(size=SIZE, eps2d=RENDERER["eps2d"])
"""As the cloud was in training."""
COLUMNS = "variant,x,object,seed,psnr,machine,commit".split(",")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--objects", nargs="+", default=["toy.glb"])
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    arguments = parser.parse_args()
    register_parts()
    done = measured_in("after_run", "object", "seed")
    for seed in arguments.seeds:
        for mesh in arguments.objects:
            if (object_name(mesh), str(seed)) not in done:
                append_rows("after_run", COLUMNS, measured(mesh, seed))
    print(table())


def measured(mesh: str, seed: int) -> list[dict[str, Any]]:
    """Rows of the CSV: what was done, to how many, and the dB that it led to."""
    with tempfile.TemporaryDirectory() as folder:
        stored = read_cloud(
            str(train(Path(folder), mesh, seed, NO_BUDGET) / f"it{STEPS}-export/gaussians.ply")
        )
    cloud = prune.tensors_of(stored)
    probes, judges, tests = prune.views_of(stored, DRAWN)
    pictures = look(cloud, tests)
    place = {"object": object_name(mesh), "seed": seed}
    return [
        place | {"variant": variant, "x": count, "psnr": round(likeness(fewer, tests, pictures), 3)}
        for count in COUNTS
        for variant, fewer in variants(cloud, count, probes, judges)
    ]


def variants(
    cloud: Gaussians, count: int, probes: Views, judges: Views
) -> Iterator[tuple[str, Gaussians]]:
    """The ways from a cloud to ``count`` Gaussians, and where they lead."""
    for name in parsimony.SCORES:
        yield f"one shot, by {name}", only(cloud, RANKS[name](cloud, probes, 0), count)
    steps = STEPS_A_ROUND * rounds_to(count, len(cloud.means))
    yield (
        "one shot, by removal, recovered",
        recover(only(cloud, worth(cloud, probes), count), probes, look(cloud, probes), steps, 0),
    )
    for name in parsimony.SCORES:
        yield (
            f"in rounds, by {name}",
            simplify(
                cloud, probes, judges, Budget(count=count), steps=STEPS_A_ROUND, rank=RANKS[name]
            ),
        )


@torch.no_grad()
def contribution(cloud: Gaussians, views: Views, seed: int) -> Tensor:
    """The largest weight in any pixel."""
    return draw(cloud, views, torch.arange(len(views.viewmats)))[1].amax(0)


RANKS = {
    "removal": worth,
    "contribution": contribution,
    "opacity": lambda cloud, views, seed: cloud.logit_opacities.detach(),
    "random": lambda cloud, views, seed: torch.rand(
        len(cloud.means), generator=torch.Generator().manual_seed(seed)
    ),
}


def table() -> str:
    """Medians over the seeds, as Markdown."""
    rows = rows_of("after_run")
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
