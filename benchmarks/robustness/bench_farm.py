"""What a farm costs beside its assets: ``python -m benchmarks.robustness.bench_farm``.

``records``: seconds and memory to start, resume and report with many rows. ``speed``:
farms of tiny guided assets with one and two workers: speed-up, seconds per asset that aren't the
asset's, and how often a worker loads each network. Results: benchmarks/results/farm.csv.
"""

import argparse
import csv
import json
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Iterator
from operator import itemgetter
from pathlib import Path
from typing import Any, Optional

from benchmarks.quality.runs import commit, machine
from threestudio_gaussiandreamer.farm.place import FINISHED, Place
from threestudio_gaussiandreamer.farm.report import write_report
from threestudio_gaussiandreamer.farm.rows import check_rows, read_rows

ROOT = Path(__file__).resolve().parents[2]
RESULTS = ROOT / "benchmarks/results/farm.csv"
COLUMNS = ("measured", "rows", "workers", "value", "unit", "machine", "commit")


# -- records ---------------------------------------------------------------------------------------


def write_rows(folder: Path, count: int) -> None:
    """Write a prompt list, and the results of every second asset."""
    with open(folder / "prompts.txt", "w") as file:
        file.writelines(f"a toy number {i} of a long list\n" for i in range(count))
    done = {"seconds": 600.0, "steps": 1200, "gaussians": 80_000, "megabytes": 9000.0}
    done |= {"hash": "0" * 64, "scores": {"psnr": 30.0}, "picture": "save/it1200-test/0.png"}
    done |= {"files": ["save/it1200-export/gaussians.ply", "save/it1200-export/gaussians.spz"]}
    for row in read_rows(folder / "prompts.txt"):
        asset = folder / "assets" / row.name
        asset.mkdir(parents=True)
        if row.line % 2:
            (asset / "result.json").write_text(json.dumps({"key": row.key, **done}))


def measure_records(stage: str, folder: Path) -> dict[str, float]:
    """Do one thing that the command does, in this process; return seconds and memory."""
    prompts = folder / "prompts.txt"
    before, began = peak_megabytes(), time.monotonic()
    count = check_rows(prompts)
    place = Place(folder / "none" if stage == "start" else folder)
    if stage == "report":
        write_report(place, read_rows(prompts), count, price=1.0)
    else:
        sum(record["state"] == FINISHED for _, record in place.records(read_rows(prompts)))
    return {"s": time.monotonic() - began, "MB": peak_megabytes() - before}


def peak_megabytes() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def bench_records(counts: list[int]) -> Iterator[dict[str, Any]]:
    """Each stage in a process of its own, so that its memory is its own."""
    for count in counts:
        with tempfile.TemporaryDirectory() as folder:
            write_rows(Path(folder), count)
            for stage in ("start", "resume", "report"):
                command = [sys.executable, "-m", "benchmarks.robustness.bench_farm"]
                done = subprocess.run(
                    [*command, "--stage", stage, folder], capture_output=True, text=True, cwd=ROOT
                )
                if done.returncode:
                    raise RuntimeError(done.stderr[-3000:])
                for unit, value in json.loads(done.stdout).items():
                    yield {"measured": stage, "rows": count, "value": value, "unit": unit}


# -- the workers -----------------------------------------------------------------------------------


def bench_speed(count: int, steps: int) -> Iterator[dict[str, Any]]:
    """The same farm with one worker and with two."""
    from tests.helpers.tiny_farm import write_farm

    seconds = {}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        arguments = write_farm(folder, count, steps)
        for workers in (1, 2):
            out = folder / "out"
            shutil.rmtree(folder / "embeddings", ignore_errors=True)
            command = [sys.executable, "-m", "threestudio_gaussiandreamer.farm", *arguments]
            command += ["--out", str(out), "--workers", str(workers)]
            subprocess.run(command, check=True, cwd=ROOT, capture_output=True)
            lines = sorted(map(timed, out.glob("assets/*/result.json")), key=itemgetter("time"))
            shutil.rmtree(out)
            seconds[workers] = duration(lines)
            rows = [
                ("seconds of the farm", seconds[workers], "s"),
                ("seconds of an asset", median_seconds(lines), "s"),
                ("overhead per asset", overhead(lines), "s"),
                ("loads of a network by a worker, most", most_loads(lines), ""),
            ]
            for measured, value, unit in rows:
                yield {"measured": measured, "rows": count, "workers": workers} | {
                    "value": value,
                    "unit": unit,
                }
    ideal = seconds[1] / seconds[2] / 2
    yield {"measured": "share of the ideal speed-up", "rows": count, "workers": 2, "value": ideal}


def timed(path: Path) -> dict[str, Any]:
    """Return a result with the time when it was written."""
    return {**json.loads(path.read_text()), "time": path.stat().st_mtime}


def duration(lines: list[dict[str, Any]]) -> float:
    """Seconds from the first asset's start to the last one's end."""
    return lines[-1]["time"] - min(line["time"] - line["seconds"] for line in lines)


def median_seconds(lines: list[dict[str, Any]]) -> float:
    ordered = sorted(line["seconds"] for line in lines)
    return ordered[len(ordered) // 2]


def overhead(lines: list[dict[str, Any]]) -> float:
    """Mean seconds between the end of an asset and that of the next one of the same worker which
    the latter's own seconds don't account for.
    """
    ends: dict[int, list[tuple[float, float]]] = defaultdict(list)
    for line in lines:
        ends[line["process"]].append((line["time"], line["seconds"]))
    gaps = [
        later[0] - earlier[0] - later[1]
        for worker in ends.values()
        for earlier, later in zip(worker, worker[1:], strict=False)
    ]
    return sum(gaps) / len(gaps)


def most_loads(lines: list[dict[str, Any]]) -> int:
    return max(count for line in lines for count in line["loads"].values())


# -- the command -----------------------------------------------------------------------------------


def write(rows: list[dict[str, Any]]) -> None:
    """Replace the rows of the same measurement in the CSV."""
    earlier = []
    if RESULTS.exists():
        with open(RESULTS, newline="") as file:
            earlier = list(csv.DictReader(file))
    measured = {(row["measured"], str(row["rows"])) for row in rows}
    kept = [row for row in earlier if (row["measured"], row["rows"]) not in measured]
    with open(RESULTS, "w", newline="") as file:
        writer = csv.DictWriter(file, COLUMNS, lineterminator="\n")
        writer.writeheader()
        writer.writerows(kept + rows)


def main(arguments: Optional[list[str]] = None) -> int:
    options = parse_arguments(arguments)
    if options.stage:
        print(json.dumps(measure_records(options.stage[0], Path(options.stage[1]))))
        return 0
    rows = []
    if "records" in options.what:
        rows += bench_records(options.rows)
    if "speed" in options.what:
        rows += bench_speed(options.assets, options.steps)
    about = {"machine": machine(), "commit": commit()}
    rows = [{**row, "value": round(row["value"], 3), **about} for row in rows]
    write(rows)
    for row in rows:
        print("  ".join(str(row.get(column, "")) for column in COLUMNS[:5]))
    return 0


def parse_arguments(arguments: Optional[list[str]]) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("what", nargs="*", default=["records", "speed"], help="records, speed")
    parser.add_argument("--rows", type=int, nargs="+", default=[10_000, 100_000])
    parser.add_argument("--assets", type=int, default=60)
    parser.add_argument("--steps", type=int, default=60)
    parser.add_argument("--stage", nargs=2, help=argparse.SUPPRESS)
    return parser.parse_args(arguments)


if __name__ == "__main__":
    sys.exit(main())
