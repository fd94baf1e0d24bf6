"""A farm under random SIGKILLs, against single runs.

``python -m benchmarks.robustness.farm_chaos`` starts a Ray cluster of a head and two machines with
one core each on this machine. Workers, the driver and whole machines are killed at random moments;
the same command is given again after each kill of the driver. At the end every asset must be
finished, finished once, and equal to the bit to a run of the launcher in a process of its own.
Result: benchmarks/results/farm_chaos.csv.
"""

import argparse
import csv
import os
import random
import re
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Optional

from benchmarks.quality.runs import commit, machine
from threestudio_gaussiandreamer.farm.worker import digest

ROOT = Path(__file__).resolve().parents[2]
RETRIES = 50
WORKER, DRIVER, NODE = "worker", "driver", "node"
ENDED = "the run at a glance"
"""What a run says at its end."""


class Cluster:
    """A head without cores, and machines with one core each, as processes of this machine."""

    def __init__(self, nodes: int) -> None:
        from ray.cluster_utils import Cluster as RayCluster

        self.ray = RayCluster(
            initialize_head=True,
            head_node_args={"num_cpus": 0, "include_dashboard": False, **self.memory()},
        )
        self.nodes = [self.ray.add_node(num_cpus=1, **self.memory()) for _ in range(nodes)]

    def memory(self) -> dict[str, int]:
        return {"object_store_memory": 80 << 20}

    def replace_node(self, rng: random.Random) -> None:
        """Kill a machine, and add a new one."""
        node = self.nodes.pop(rng.randrange(len(self.nodes)))
        self.ray.remove_node(node, allow_graceful=False)
        self.nodes.append(self.ray.add_node(num_cpus=1, **self.memory()))

    def close(self) -> None:
        self.ray.shutdown()


def descendants(pid: int) -> Iterator[int]:
    """Yield the processes below ``pid``."""
    parents: dict[int, list[int]] = {}
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            try:
                fields = (entry / "stat").read_text().rpartition(")")[2].split()
            except OSError:
                continue
            parents.setdefault(int(fields[1]), []).append(int(entry.name))
    pending = [pid]
    while pending:
        children = parents.get(pending.pop(), [])
        yield from children
        pending += children


def busy_workers() -> list[int]:
    """Processes of the farm's workers that make an asset now."""
    found = []
    for pid in descendants(os.getpid()):
        try:
            title = Path(f"/proc/{pid}/cmdline").read_bytes()
        except OSError:
            continue
        if title.startswith(b"ray::Worker.make"):
            found.append(pid)
    return found


def training_workers(out: Path) -> list[int]:
    """Processes of the workers whose asset has a checkpoint and isn't finished."""
    folders = {path.parents[1] for path in out.glob("assets/*/ckpts/*.ckpt")}
    left = [folder for folder in folders if not (folder / "result.json").exists()]
    last = {int((folder / "attempts.txt").read_text().split()[-1]) for folder in left}
    return sorted(last & set(busy_workers()))


class Chaos:
    """One farm and its disturbances.

    Args:
        command: of the farm.
        out: its folder.
        events: kinds of kills, in their order.
    """

    def __init__(
        self,
        command: list[str],
        out: Path,
        events: list[str],
        cluster: Cluster,
        options: argparse.Namespace,
    ) -> None:
        self.command, self.out, self.events, self.cluster = command, out, events, cluster
        self.rng = random.Random(options.seed)
        self.longest = options.longest
        self.done: Counter = Counter()
        self.in_training = False
        self.log = options.log
        self.driver = self.start()

    def start(self) -> subprocess.Popen:
        file = open(self.log, "ab") if self.log else subprocess.DEVNULL
        return subprocess.Popen(self.command, cwd=ROOT, stdout=file, stderr=file)

    def run(self, deadline: float) -> int:
        """Disturb the farm until all events have happened, and let it end; return its code."""
        due = self.next_due()
        while self.driver.poll() is None:
            if time.monotonic() > deadline:
                self.driver.kill()
                raise RuntimeError("not done in the given time")
            if self.events and time.monotonic() > due and self.disturb(self.events[0]):
                self.done[self.events.pop(0)] += 1
                due = self.next_due()
            time.sleep(0.05)
        return self.driver.returncode

    def next_due(self) -> float:
        """Draw the time of the next event, and whether it waits for an asset with a checkpoint."""
        self.in_training = self.rng.random() < 0.5
        return time.monotonic() + self.rng.uniform(0, self.longest)

    def disturb(self, event: str) -> bool:
        """Kill; return False if there is nothing to kill yet."""
        workers = training_workers(self.out) if self.in_training else busy_workers()
        if not workers:
            return False
        if event == WORKER:
            os.kill(self.rng.choice(workers), signal.SIGKILL)
        elif event == DRIVER:
            self.driver.kill()
            self.driver.wait()
            self.driver = self.start()
        else:
            self.cluster.replace_node(self.rng)
        return True


# -- what is left ----------------------------------------------------------------------------------


def trained_to_the_end(out: Path) -> list[int]:
    """How often each finished asset's run was trained to its end, by its log."""
    logs = [path.parent / "log.txt" for path in out.glob("assets/*/result.json")]
    return [path.read_text(errors="replace").count(ENDED) for path in logs]


def resumed(out: Path) -> int:
    """How often an asset went on from a checkpoint."""
    logs = [path.read_text(errors="replace") for path in out.glob("assets/*/log.txt")]
    return sum(len(re.findall("resume=auto: resuming from", log)) for log in logs)


def equal_to_single_runs(folder: Path, out: Path, count: int, steps: int) -> int:
    """Make each asset alone, and count those whose exported files are the same."""
    from tests.helpers.tiny_farm import make_alone

    same = 0
    for number in range(count):
        alone = digest(make_alone(folder, number, steps))
        same += alone == digest(out / "assets" / f"toy{number}")
        print(f"\rsingle run {number + 1} of {count}, {same} equal ", end="", file=sys.stderr)
    print(file=sys.stderr)
    return same


def report(
    options: argparse.Namespace, chaos: Chaos, folder: Path, out: Path, seconds: float
) -> dict[str, Any]:
    ends = trained_to_the_end(out)
    attempts = [len(path.read_text().splitlines()) for path in out.glob("assets/*/attempts.txt")]
    return {
        "assets": options.assets,
        "steps": options.steps,
        "worker_kills": chaos.done[WORKER],
        "driver_kills": chaos.done[DRIVER],
        "node_kills": chaos.done[NODE],
        "finished": len(ends),
        "finished_twice": sum(count > 1 for count in ends),
        "equal_to_single_runs": equal_to_single_runs(folder, out, options.assets, options.steps),
        "attempts": sum(attempts),
        "resumed_from_checkpoint": resumed(out),
        "seconds": round(seconds, 1),
        "seed": options.seed,
        "machine": machine(),
        "commit": commit(),
    }


def main(arguments: Optional[list[str]] = None) -> int:
    options = parse_arguments(arguments)
    events = [WORKER] * options.workers + [DRIVER] * options.drivers + [NODE] * options.nodes
    random.Random(options.seed).shuffle(events)
    wanted = len(events)
    with tempfile.TemporaryDirectory() as name:
        from tests.helpers.tiny_farm import write_farm

        folder = Path(name)
        out = folder / "farm"
        cluster = Cluster(nodes=2)
        try:
            began = time.monotonic()
            command = [
                *(sys.executable, "-m", "threestudio_gaussiandreamer.farm"),
                *write_farm(folder, options.assets, options.steps),
                *("--out", str(out), "--address", cluster.ray.address),
                *("--retries", str(RETRIES)),
            ]
            chaos = Chaos(command, out, events, cluster, options)
            code = chaos.run(began + 60 * options.minutes)
            seconds = time.monotonic() - began
        finally:
            cluster.close()
        result = report(options, chaos, folder, out, seconds)
    print("\n".join(f"{name:<26}{value}" for name, value in result.items()))
    write(options.out, result)
    holds = result["finished"] == result["equal_to_single_runs"] == options.assets
    holds = holds and not result["finished_twice"] and sum(chaos.done.values()) == wanted
    return 0 if holds and code == 0 else 1


def write(path: Path, result: dict[str, Any]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    with open(path, "w", newline="") as file:
        writer = csv.DictWriter(file, list(result), lineterminator="\n")
        writer.writeheader()
        writer.writerow(result)


def parse_arguments(arguments: Optional[list[str]]) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--assets", type=int, default=60)
    parser.add_argument("--steps", type=int, default=60)
    parser.add_argument("--workers", type=int, default=30, help="kills of workers")
    parser.add_argument("--drivers", type=int, default=5, help="kills of the driver")
    parser.add_argument("--nodes", type=int, default=2, help="kills of machines")
    parser.add_argument("--longest", type=float, default=12, help="seconds between two kills")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--minutes", type=float, default=60, help="give up after this long")
    parser.add_argument("--log", help="append what the farm prints to this file")
    parser.add_argument("--out", type=Path, default=ROOT / "benchmarks/results/farm_chaos.csv")
    return parser.parse_args(arguments)


if __name__ == "__main__":
    sys.exit(main())
