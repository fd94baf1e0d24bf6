"""A long run that is killed again and again: what does it lose, and does its memory grow? One
command, within half an hour.

    python -m benchmarks.robustness.long_run                           # 20,000 steps and 50 kills:
                                                            ten minutes or so on one core
    python -m benchmarks.robustness.long_run --steps 400 --kills 3     # in a minute

The same small run (configs/demo.yaml at 24^2 with 200 Gaussians, validated and saved every few
steps) twice. Once undisturbed, its memory sampled; and once killed with SIGKILL at random moments,
while it imports, loads, trains, validates or writes, and each time started again with the same
command line, which holds `resume=auto`. Nobody looks on. It holds when every start goes on from the
last checkpoint that was written, and the last cloud and its optimiser are the undisturbed run's to
the bit."""

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
from benchmarks.robustness.supervisor import ROOT, Life, Sample, Supervisor, last_written

SAMPLE_EVERY = 0.5  # seconds
PROGRESS = 0.7
"""The share of the steps that is expected to be done when the last kill falls; the rest is done in
peace.
"""
AT_MOST = 0.85
"""A life that gets on faster is killed when it has written its part of this share, so that there is
a run left for the others.
"""


# -- undisturbed -----------------------------------------------------------------------------------


def undisturbed(run: Supervisor) -> list[Sample]:
    """The run from start to end in one process, its memory sampled."""
    process, started, samples = run.start(), time.monotonic(), []
    while process.poll() is None:
        if time.monotonic() > run.deadline:
            process.kill()
            raise RuntimeError("not done in the given time")
        resident = resident_megabytes(process.pid)
        if resident is not None:
            samples.append(Sample(time.monotonic() - started, last_written(run.folder), resident))
        time.sleep(SAMPLE_EVERY)
    if process.returncode:
        raise RuntimeError(
            f"the undisturbed run failed ({process.returncode}):\n{run.said()[-3000:]}"
        )
    return samples


def resident_megabytes(pid: int) -> Optional[float]:
    try:
        found = re.search(r"RssAnon:\s+(\d+) kB", Path(f"/proc/{pid}/status").read_text())
    except OSError:
        return None
    return int(found[1]) / 1024 if found else None


def memory_slope(samples: list[Sample], steps: int) -> dict[str, Any]:
    """MB per 1000 steps, fitted to what was sampled in the second half, when caches are full and
    the cloud has its size.
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


# -- killed ----------------------------------------------------------------------------------------


def killed(
    run: Supervisor, kills: int, startup: float, rate: float, rng: random.Random
) -> list[Life]:
    """Lives of the run, killed at moments uniform from its start to where it is expected to have
    done its share of the steps.
    """
    longest = longest_life(startup, gain=PROGRESS * run.steps / kills / rate)
    lives: list[Life] = []
    while sum(life.killed for life in lives) < kills and (not lives or lives[-1].killed):
        lives.append(
            run.live(rng.uniform(0, longest), AT_MOST * run.steps * (len(lives) + 1) / kills)
        )
        show(lives, kills)
    if lives[-1].killed:
        lives.append(run.live())
    return lives


def longest_life(startup: float, gain: float) -> float:
    """The seconds T for which lives that end uniformly on [0, T] train ``gain`` seconds on average:
    (T - startup)^2 / 2T = gain.
    """
    return startup + gain + math.sqrt(gain**2 + 2 * gain * startup)


def show(lives: list[Life], kills: int) -> None:
    if sys.stderr.isatty():
        print(
            f"\rkill {len(lives)} of {kills}, step {lives[-1].reached} ",
            end="",
            file=sys.stderr,
            flush=True,
        )


def lost_steps(lives: list[Life]) -> int:
    """Steps that had been written and were trained again: by how much a life went on from less than
    what the one before left.
    """
    return sum(
        max(0, before.reached - after.started_from)
        for before, after in zip(lives, lives[1:], strict=False)
    )


def startup_seconds(samples: list[Sample], every: int) -> tuple[float, float]:
    """Seconds until the first step, and steps per second after it, from when checkpoints were
    there.
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
        calm, disturbed = (
            Supervisor(Path(folder, name), options.steps, options.every, deadline)
            for name in ("calm", "killed")
        )
        for run in (calm, disturbed):
            run.folder.mkdir()
        samples = undisturbed(calm)
        startup, rate = startup_seconds(samples, options.every)
        lives = killed(disturbed, options.kills, startup, rate, random.Random(options.seed))
        result = report(options, calm, disturbed, samples, lives) | {
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
    parser.add_argument("--seed", type=int, default=0, help="of the moments of the kills")
    parser.add_argument("--minutes", type=float, default=30, help="give up after this long")
    parser.add_argument("--out", type=Path, default=ROOT / "benchmarks/results/long_run.json")
    return parser.parse_args(arguments)


def report(
    options: argparse.Namespace,
    calm: Supervisor,
    disturbed: Supervisor,
    samples: list[Sample],
    lives: list[Life],
) -> dict[str, Any]:
    hashes = calm.digest(), disturbed.digest()
    kills = [life for life in lives if life.killed]
    result = {
        "steps": options.steps,
        "checkpoint_every": options.every,
        "kills": len(kills),
        "kills_before_a_checkpoint": sum(life.reached == life.started_from for life in kills),
        "written_steps_lost": lost_steps(lives),
        "same_final_state": hashes[0] == hashes[1],
        "final_state": hashes[1],
        "final_step": disturbed.newest_step(),
        "half_written_files": len(disturbed.leftovers()),
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
        "written steps lost": str(result["written_steps_lost"]),
        "final state": (
            "the undisturbed run's to the bit"
            if result["same_final_state"]
            else "ANOTHER than the undisturbed run's"
        ),
        "half-written files left": str(result["half_written_files"]),
        "memory": f"{slope:+.3f} +- {memory['standard_error']:.3f} MB per 1000 steps; peak "
        f"{memory['peak_mb']:.0f} MB",
        "time": f"{result['minutes']:.1f} minutes; {result['startup_seconds']:.1f} s to start, "
        f"{result['steps_per_second']:.0f} steps/s",
    }
    return "\n".join(f"{name:<26}{value}" for name, value in rows.items())


if __name__ == "__main__":
    sys.exit(main())
