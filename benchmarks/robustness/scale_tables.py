"""The generated parts of docs/scale.md, from docs/charts/unit_costs.csv, and scale.csv and farm.csv
in benchmarks/results.
"""

import statistics

from benchmarks.markdown import markdown, read
from benchmarks.robustness.scale import (
    RESULTS,
    Rates,
    Scenario,
    median_of,
    scenarios,
    values_of,
)

MILLION = 1_000_000
STORAGE_DOLLARS, PUT_DOLLARS = 0.023, 5e-6
"""A GB for a month, and an upload of one file."""


def unit_costs() -> str:
    """Return CPU seconds and peak memory of each stage, and the files that an asset leaves."""
    seconds, memory = values_of("stage", "s"), values_of("stage", "MB")
    rows = [
        (
            name,
            f"{statistics.median(seconds[name]):.1f} s, {statistics.median(memory[name]):.0f} MB",
        )
        for name in seconds
    ]
    sizes, counts = values_of("files", "bytes"), values_of("files", "files")
    rows += [
        (
            name,
            f"{statistics.median(size) / 1e6:.2f} MB, {statistics.median(counts[name]):.0f} files",
        )
        for name, size in sizes.items()
    ]
    rows.append(("lines in the ledger", f"{median_of('driver', 'bytes'):.0f} bytes"))
    return markdown(("stage or files", "CPU seconds, peak memory; or size"), rows)


def stated() -> str:
    """Return the rates and prices that the simulation assumes."""
    rates = Rates()
    rows = [
        ("machines taken away, an hour of a worker", f"{rates.spot_losses:g}"),
        ("workers that die, an hour", f"{rates.crashes:g}"),
        ("assets that hang; that fail whatever is done", f"{rates.hangs:g}; {rates.failures:g}"),
        ("slow machines, their time over the others'", f"{rates.slow:g}, {rates.slowness:g}"),
        ("until a lost machine is replaced", f"{rates.replacement:.0f} s"),
        ("a GB for a month", f"${STORAGE_DOLLARS:g}"),
        ("a thousand uploads", f"${1000 * PUT_DOLLARS:g}"),
    ]
    for found in scenarios():
        times = f"{found.seconds:.0f} s an asset, {found.load:.0f} s to start"
        worker = f"{times}, ${found.dollars:g} an hour"
        rows.append((f"{found.name}, a preemptible worker", worker))
    return markdown(("stated", "value"), rows)


def runs() -> str:
    """Return what a million assets take, for each scenario and with each answer left out."""
    rows = [
        (
            row["scenario"],
            f"{int(row['workers']):,}",
            row["variant"],
            f"{float(row['hours']):.1f}",
            f"{float(row['last_percent_hours']):.1f}",
            f"{float(row['worker_hours']):,.0f}",
            f"{float(row['wasted_percent']):.1f}",
            f"{int(row['failed']):,}",
            f"{int(row['made_again']):,}",
            f"{float(row['dollars']):,.0f}",
        )
        for row in read(RESULTS)
    ]
    head = ("workload", "workers", "variant", "hours", "of them the last 1 %", "worker-hours")
    return markdown((*head, "wasted, %", "failed", "restarted from scratch", "dollars"), rows)


def storage() -> str:
    """Return what a million assets take in the store, in all and without checkpoints."""
    sizes, counts = values_of("files", "bytes"), values_of("files", "files")
    kept = {
        "all files": list(sizes),
        "without checkpoints": [name for name in sizes if name != "checkpoint"],
        "exported clouds and pages only": ["exported clouds and pages"],
    }
    rows = []
    for title, names in kept.items():
        terabytes = sum(statistics.median(sizes[name]) for name in names) * MILLION / 1e12
        files = sum(statistics.median(counts[name]) for name in names) * MILLION
        month = f"{terabytes * 1000 * STORAGE_DOLLARS:,.0f}"
        puts = f"{files * PUT_DOLLARS:,.0f}"
        rows.append((title, f"{terabytes:.1f}", f"{files / 1e6:.0f}", month, puts))
    return markdown(("kept", "TB", "million files", "dollars a month", "dollars of uploads"), rows)


def limits() -> str:
    """Return the parts that don't grow with the workers, the first to break first."""
    rows = []
    for scenario in scenarios():
        workers, seconds = driver_limit(scenario)
        rate = scenario.workers / scenario.seconds
        size = median_of("files", "bytes") * rate / 1e6
        share = f"{100 * rate * seconds:.1f} % of one core"
        rows += [
            (f"the driver, {scenario.name}", share, f"{workers:,.0f} workers"),
            (f"uploads, {scenario.name}", f"{size:.0f} MB/s", "the store's bandwidth"),
        ]
    for stage in ("start", "resume", "report"):
        seconds = extrapolated(stage, "s")
        rows.append((f"{stage} of the command", f"{seconds:.0f} s", "grows with the assets"))
    ledger = median_of("driver", "bytes") * MILLION / 1e9
    index = extrapolated("resume", "MB")
    rows.append(("the ledger", f"{ledger:.1f} GB on the disk", "grows with the assets"))
    rows.append(("the ledger's index", f"{index:.0f} MB of memory", "grows with the assets"))
    return markdown(("part", "for a million assets", "breaks at"), rows)


def extrapolated(stage: str, unit: str) -> float:
    """Return a measurement of farm.csv for a million rows, from its last two in proportion."""
    rows = [
        r
        for r in read(RESULTS.with_name("farm.csv"))
        if (r["measured"], r["unit"]) == (stage, unit)
    ]
    (few, low), (many, high) = sorted((int(r["rows"]), float(r["value"])) for r in rows)[-2:]
    return high + max(0.0, high - low) / (many - few) * (MILLION - many)


def driver_limit(scenario: Scenario) -> tuple[float, float]:
    """Return how many workers one driver serves, and its seconds per asset at the scenario's.

    The seconds at other numbers of workers are interpolated, and extrapolated with the last slope.
    """
    measured = {
        int(name.split()[0]): statistics.median(values)
        for name, values in values_of("driver", "s").items()
    }
    points = sorted(measured.items())

    def seconds(workers: float) -> float:
        low, high = points[-2:]
        for pair in zip(points, points[1:], strict=False):
            if workers <= pair[1][0]:
                low, high = pair
                break
        slope = (high[1] - low[1]) / (high[0] - low[0])
        return max(low[1] + slope * (workers - low[0]), points[0][1])

    few, many = 1.0, 1e9
    while many / few > 1.001:
        middle = (few * many) ** 0.5
        busy = middle / scenario.seconds * seconds(middle)
        few, many = (few, middle) if busy > 1 else (middle, many)
    return few, seconds(scenario.workers)
