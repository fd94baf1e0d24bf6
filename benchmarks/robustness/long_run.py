"""Measure what a long run loses when it is killed repeatedly, and whether its memory grows.

    python -m benchmarks.robustness.long_run                           # 20,000 steps and 50 kills
    python -m benchmarks.robustness.long_run --steps 400 --kills 3     # a short version

A small run (configs/demo.yaml at 24^2 with 200 Gaussians, validated and saved every few steps) is
trained twice: once uninterrupted, while its memory is sampled, and once killed with SIGKILL at
random moments (importing, loading, training, validating, writing) and restarted with the same
command line, which contains `resume=auto`. The test passes if every process continues from the last
checkpoint written, and the final cloud and optimiser equal the uninterrupted run's to the bit."""

import argparse
import json
import math
import random
import re
import sys
import tempfile
import time
from pathlib import Path
from typing import Any, Optional

import numpy as np

from benchmarks.quality.runs import commit, machine
from benchmarks.robustness.supervisor import ROOT, Sample, Segment, Supervisor, last_written

SAMPLE_EVERY = 0.5  # seconds
PROGRESS = 0.7
"""Expected fraction of the steps at the last kill; the rest runs uninterrupted."""
AT_MOST = 0.85
"""Fraction of the steps at which the kills must be done: a process that is faster is killed
earlier, when it has written its part.
"""


# -- the uninterrupted run -------------------------------------------------------------------------


def uninterrupted(run: Supervisor) -> list[Sample]:
    """Run from start to end in one process, and sample its memory."""
    process, started, samples = run.start(), time.monotonic(), []
    while process.poll() is None:
        if time.monotonic() > run.deadline:
            process.kill()
            raise RuntimeError("not finished within the time limit")
        resident = resident_megabytes(process.pid)
        if resident is not None:
            samples.append(Sample(time.monotonic() - started, last_written(run.folder), resident))
        time.sleep(SAMPLE_EVERY)
    if process.returncode:
        raise RuntimeError(
            f"the uninterrupted run failed ({process.returncode}):\n{run.output()[-3000:]}"
        )
    return samples


def resident_megabytes(pid: int) -> Optional[float]:
    try:
        found = re.search(r"RssAnon:\s+(\d+) kB", Path(f"/proc/{pid}/status").read_text())
    except OSError:
        return None
    return int(found[1]) / 1024 if found else None


def memory_slope(samples: list[Sample], steps: int) -> dict[str, Any]:
    """Fit MB per 1000 steps to the samples of the second half, when caches are full and the cloud
    has its final size.
    """
    steady = [sample for sample in samples if steps / 2 <= sample.step < steps]
    all_along = [sample for sample in samples if 0 < sample.step < steps]
    at, resident = (
        np.array([s.step for s in steady]) / 1000,
        np.array([s.megabytes for s in steady]),
    )
    (slope, _), covariance = (
        np.polyfit(at, resident, 1, cov=True)
        if len(steady) > 4
        else ((math.nan, 0), np.full((2, 2), math.nan))
    )
    error = math.sqrt(covariance[0, 0])
    return {
        "mb_per_1000_steps": round(float(slope), 4),
        "standard_error": round(error, 4),
        "samples": len(steady),
        "peak_mb": round(max(s.megabytes for s in samples), 1),
        "mb_at_step": {
            sample.step: round(sample.megabytes, 1)
            for sample in all_along[:: max(1, len(all_along) // 20)]
        },
    }


# -- the interrupted run ---------------------------------------------------------------------------


def killed(
    run: Supervisor, kills: int, startup: float, rate: float, rng: random.Random
) -> list[Segment]:
    """Run with kills: each process is killed at a time uniform between its start and the time at
    which it should have done its share of the steps.
    """
    longest = longest_segment(startup, gain=PROGRESS * run.steps / kills / rate)
    segments: list[Segment] = []
    while sum(segment.killed for segment in segments) < kills and (
        not segments or segments[-1].killed
    ):
        segments.append(
            run.run_segment(
                rng.uniform(0, longest), AT_MOST * run.steps * (len(segments) + 1) / kills
            )
        )
        show(segments, kills)
    if segments[-1].killed:
        segments.append(run.run_segment())
    return segments


def longest_segment(startup: float, gain: float) -> float:
    """Return the seconds T for which processes killed uniformly on [0, T] train ``gain`` seconds on
    average: (T - startup)^2 / 2T = gain.
    """
    return startup + gain + math.sqrt(gain**2 + 2 * gain * startup)


def show(segments: list[Segment], kills: int) -> None:
    if sys.stderr.isatty():
        print(
            f"\rkill {len(segments)} of {kills}, step {segments[-1].reached} ",
            end="",
            file=sys.stderr,
            flush=True,
        )


def lost_steps(segments: list[Segment]) -> int:
    """Count checkpointed steps that were trained again, because a process resumed from an earlier
    one.
    """
    return sum(
        max(0, before.reached - after.started_from)
        for before, after in zip(segments, segments[1:], strict=False)
    )


def startup_seconds(samples: list[Sample], every: int) -> tuple[float, float]:
    """Return the seconds until the first step and the steps per second after it, from the times of
    the checkpoints.
    """
    training = [sample for sample in samples if sample.step]
    first, last = (
        training[0],
        next((s for s in training if s.step == training[-1].step), training[-1]),
    )
    rate = (last.step - first.step) / max(
        last.seconds - first.seconds, SAMPLE_EVERY
    ) or every / SAMPLE_EVERY
    return max(first.seconds - first.step / rate, 0.5), rate


# -- the command -----------------------------------------------------------------------------------


def main(arguments: Optional[list[str]] = None) -> int:
    options = parse_arguments(arguments)
    began = time.monotonic()
    deadline = began + 60 * options.minutes
    with tempfile.TemporaryDirectory() as folder:
        reference, interrupted = (
            Supervisor(Path(folder, name), options.steps, options.every, deadline)
            for name in ("reference", "killed")
        )
        for run in (reference, interrupted):
            run.folder.mkdir()
        samples = uninterrupted(reference)
        startup, rate = startup_seconds(samples, options.every)
        segments = killed(interrupted, options.kills, startup, rate, random.Random(options.seed))
        result = report(options, reference, interrupted, samples, segments) | {
            "startup_seconds": round(startup, 2),
            "steps_per_second": round(rate, 1),
        }
    result["minutes"] = round((time.monotonic() - began) / 60, 1)
    print(table(result))
    options.out.parent.mkdir(parents=True, exist_ok=True)
    options.out.write_text(json.dumps(result, indent=1) + "\n")
    print(f"\n{options.out}")
    return 0 if result["holds"] else 1


def parse_arguments(arguments: Optional[list[str]]) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--steps", type=int, default=20_000)
    parser.add_argument("--kills", type=int, default=50)
    parser.add_argument(
        "--every",
        type=int,
        default=50,
        help="steps between checkpoints; ten times as many between validations",
    )
    parser.add_argument("--seed", type=int, default=0, help="seed of the times of the kills")
    parser.add_argument("--minutes", type=float, default=30, help="give up after this long")
    parser.add_argument("--out", type=Path, default=ROOT / "benchmarks/results/long_run.json")
    return parser.parse_args(arguments)


def report(
    options: argparse.Namespace,
    reference: Supervisor,
    interrupted: Supervisor,
    samples: list[Sample],
    segments: list[Segment],
) -> dict[str, Any]:
    hashes = reference.digest(), interrupted.digest()
    kills = [segment for segment in segments if segment.killed]
    result = {
        "steps": options.steps,
        "checkpoint_every": options.every,
        "kills": len(kills),
        "kills_before_a_checkpoint": sum(
            segment.reached == segment.started_from for segment in kills
        ),
        "written_steps_lost": lost_steps(segments),
        "same_final_state": hashes[0] == hashes[1],
        "final_state": hashes[1],
        "final_step": interrupted.newest_step(),
        "half_written_files": len(interrupted.leftovers()),
        "memory": memory_slope(samples, options.steps),
        "machine": machine(),
        "commit": commit(),
    }
    asked = len(kills) >= options.kills and result["final_step"] == options.steps
    return result | {
        "holds": asked and result["same_final_state"] and not result["written_steps_lost"]
    }


def table(result: dict[str, Any]) -> str:
    memory, slope = result["memory"], result["memory"]["mb_per_1000_steps"]
    rows = {
        "steps": f"{result['final_step']} of {result['steps']}",
        "killed with SIGKILL": f"{result['kills']} times "
        f"({result['kills_before_a_checkpoint']} before the process had written anything)",
        "checkpointed steps lost": str(result["written_steps_lost"]),
        "final state": (
            "equal to the uninterrupted run's"
            if result["same_final_state"]
            else "DIFFERENT from the uninterrupted run's"
        ),
        "partially written files": str(result["half_written_files"]),
        "memory": f"{slope:+.3f} +- {memory['standard_error']:.3f} MB per 1000 steps; peak "
        f"{memory['peak_mb']:.0f} MB",
        "time": f"{result['minutes']:.1f} minutes; {result['startup_seconds']:.1f} s to start, "
        f"{result['steps_per_second']:.0f} steps/s",
    }
    return "\n".join(f"{name:<26}{value}" for name, value in rows.items())


if __name__ == "__main__":
    sys.exit(main())
