"""Simulate a farm of a million assets: ``python -m benchmarks.robustness.scale``.

Durations are drawn from measured trainings, restarts and checkpoints from measured stages; rates of
failures and prices are stated in this file. Each scenario is simulated with the farm's answers to
failures and without one of them at a time. Writes benchmarks/results/scale.csv; ``python -m
benchmarks.tables`` makes docs/scale.md from it.
"""

import argparse
import csv
import heapq
import math
import random
import statistics
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

from benchmarks.markdown import read
from benchmarks.quality.runs import CHARTS, commit
from benchmarks.robustness.unit_costs import IMPORTS, START
from threestudio_gaussiandreamer.launch.callbacks import SECONDS_BETWEEN

RESULTS = Path(__file__).resolve().parents[1] / "results/scale.csv"
COLUMNS = (
    "scenario", "variant", "assets", "workers", "hours", "last_percent_hours", "worker_hours",
    "wasted_percent", "failed", "made_again", "dollars", "seed", "commit",
)  # fmt: skip
HOUR = 3600.0


class Rates(NamedTuple):
    """Stated, not measured."""

    spot_losses: float = 0.05
    """A machine is taken away, per hour of a worker."""
    crashes: float = 0.002
    """A worker dies, per hour of a worker."""
    hangs: float = 2e-4
    """An asset makes no more steps, per asset."""
    failures: float = 1e-3
    """An asset fails whatever is done, per asset."""
    slow: float = 0.05
    """Share of slow machines."""
    slowness: float = 2.5
    """Their time, over that of the others."""
    replacement: float = 180.0
    """Seconds until a lost machine is replaced."""
    retries: int = 3
    """Losses of a worker before an asset is begun again with less memory (``--retries``)."""
    time_limit: float = 1800.0
    """Seconds without a step until a worker is restarted (``--time-limit``)."""


class Scenario(NamedTuple):
    """Assets of one kind on workers of one kind."""

    name: str
    seconds: float
    """Median of an asset."""
    load: float
    """Seconds that a new worker loads models."""
    workers: int
    dollars: float
    """An hour of a worker, preemptible."""


class Farm(NamedTuple):
    """Which of the farm's answers to failures are in force."""

    resumes: bool = True
    """An asset goes on from its checkpoint."""
    restarts_hung: bool = True
    """A hung worker is restarted after the time limit; else it is lost until the end."""


VARIANTS = {
    "nothing fails": (Rates(0, 0, 0, 0, 0), Farm()),
    "the farm": (Rates(), Farm()),
    "without checkpoints": (Rates(), Farm(resumes=False)),
    "without the time limit": (Rates(), Farm(restarts_hung=False)),
    "on machines that aren't taken away, at three times the price": (Rates(0), Farm()),
}


class Asset(NamedTuple):
    """What became of one asset on one worker."""

    seconds: float
    useful: float
    failed: bool
    again: bool
    """Whether it was begun again from its first step."""
    hung: bool
    """Whether its worker does nothing any more."""


def spread() -> list[float]:
    """Return measured CPU seconds of trainings of the same configuration, over their median."""
    rows = [row for row in read(CHARTS / "quality.csv") if row["variant"] == "default"]
    last: dict[tuple[str, str], float] = {}
    for row in rows:
        place = row["object"], row["seed"]
        last[place] = max(last.get(place, 0.0), float(row["cpu_seconds"]))
    median = statistics.median(last.values())
    return [seconds / median for seconds in last.values()]


def median_of(measured: str, unit: str, *names: str) -> float:
    """Return the sum of the medians of these names, by default of all; see :func:`values_of`."""
    found = values_of(measured, unit)
    return sum(statistics.median(found[name]) for name in names or found)


def values_of(measured: str, unit: str) -> dict[str, list[float]]:
    """Return the values of docs/charts/unit_costs.csv over the seeds, by name."""
    found: dict[str, list[float]] = {}
    for row in read(CHARTS / "unit_costs.csv"):
        if (row["measured"], row["unit"]) == (measured, unit):
            found.setdefault(row["name"], []).append(float(row["value"]))
    return found


def scenarios() -> list[Scenario]:
    asset, start = median_of("stage", "s"), median_of("stage", "s", IMPORTS, START)
    return [
        Scenario("the demo on CPU cores", asset, start, 2000, 0.015),
        # 15 minutes: the paper's, on an RTX 3090; a minute to load the models is stated
        Scenario("GaussianDreamer on GPUs", 900.0, 60.0, 1000, 0.25),
    ]


def make(base: float, slowness: float, load: float, rates: Rates, farm: Farm, rng: Any) -> Asset:
    """Simulate one asset.

    Args:
        base: seconds without failures on a machine of the usual speed.
        load: seconds in which a new worker loads models.
    """
    useful = left = base * slowness
    spent, losses, again = 0.0, 0, False
    hangs = rng.random() < rates.hangs
    hourly = rates.spot_losses + rates.crashes
    while True:
        until_loss = rng.expovariate(hourly / HOUR) if hourly else math.inf
        if hangs and until_loss > left / 2:
            hangs = False
            if not farm.restarts_hung:
                return Asset(spent + left / 2, useful, True, again, True)
            spent += left / 2 + rates.time_limit + load
            left = left / 2 if farm.resumes else useful
            continue
        if until_loss >= left:
            failed = rng.random() < rates.failures
            return Asset(spent + left, useful, failed, again, False)
        is_spot = rng.random() * hourly < rates.spot_losses
        spent += until_loss + load + (rates.replacement if is_spot else 0.0)
        losses += 1
        if losses > rates.retries and not again:
            losses, again, left = 0, True, useful
        elif farm.resumes:
            left -= max(0.0, until_loss - rng.random() * SECONDS_BETWEEN)
        else:
            left = useful


def simulate(
    scenario: Scenario, rates: Rates, farm: Farm, assets: int, seed: int
) -> dict[str, Any]:
    """Hand the assets to the workers in order, each to the first that is idle."""
    rng, relative = random.Random(seed), spread()
    speeds = [rates.slowness if rng.random() < rates.slow else 1.0 for _ in range(scenario.workers)]
    idle = [(scenario.load, worker) for worker in range(scenario.workers)]
    ends, useful, failed, again = [], 0.0, 0, 0
    for _ in range(assets):
        if not idle:
            break
        now, worker = heapq.heappop(idle)
        base = scenario.seconds * rng.choice(relative)
        made = make(base, speeds[worker], scenario.load, rates, farm, rng)
        ends.append(now + made.seconds)
        useful += 0.0 if made.failed else made.useful
        failed, again = failed + made.failed, again + made.again
        if not made.hung:
            heapq.heappush(idle, (now + made.seconds, worker))
    ends.sort()
    end = ends[-1]
    paid = scenario.workers * end / HOUR
    return {
        "hours": end / HOUR,
        "last_percent_hours": (end - ends[int(0.99 * len(ends))]) / HOUR,
        "worker_hours": paid,
        "wasted_percent": 100 * (1 - useful / HOUR / paid),
        "failed": failed + assets - len(ends),
        "made_again": again,
        "dollars": paid * scenario.dollars,
    }


def rows(assets: int, seed: int) -> Iterator[dict[str, Any]]:
    for scenario in scenarios():
        for variant, (rates, farm) in VARIANTS.items():
            price = 3 if variant.endswith("price") else 1
            priced = scenario._replace(dollars=price * scenario.dollars)
            found = simulate(priced, rates, farm, assets, seed)
            place = {"scenario": scenario.name, "variant": variant, "workers": scenario.workers}
            yield {**place, "assets": assets, "seed": seed, "commit": commit(), **found}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--assets", type=int, default=1_000_000)
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    with open(RESULTS, "w", newline="") as file:
        writer = csv.DictWriter(file, COLUMNS, lineterminator="\n")
        writer.writeheader()
        for row in rows(arguments.assets, arguments.seed):
            row = {k: round(v, 3) if isinstance(v, float) else v for k, v in row.items()}
            print(row, flush=True)
            writer.writerow(row)


if __name__ == "__main__":
    main()
