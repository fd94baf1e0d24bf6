"""Text to 3D with the toybox's models: toybox.yaml, what it is compared with, and other options.

    python -m benchmarks.quality.toybox                                     # all missing runs
    python -m benchmarks.quality.toybox --charts default paper --prompts withheld --count 20
    python -m benchmarks.quality.toybox --variant "wide 0 system.geometry.scale_factor=2"
    python -m benchmarks.quality.toybox --models FOLDER --jobs 16 --seconds 340 --out DIR
    python -m benchmarks.quality.toybox --keep RUNS --only-score            # by another judge
    python -m benchmarks.quality.toybox --gpu 0 --jobs 16                   # rows in toybox_gpu.csv

Each run is configs/toybox.yaml with a few options changed, on one thread. The judge sees eight
views of its result, of its prior's points, of the 2D model's own samples, and of the object itself;
CPU seconds are those of a whole run without imports and video, in a process that keeps its networks
loaded. A CPU that doesn't multiply bfloat16 computes the networks in float32, with the same results
in more seconds, which are left out of docs/charts. Seconds on a GPU, which the runs side by side
share, are left out too.
Rows are appended to toybox.csv, or toybox_gpu.csv, as runs end, in the order chart, seed, prompt,
variant. Rows that it has of this configuration, these models and this judge, which the columns
"setup" and "judge" identify, are skipped.
Settings were chosen on "seen" prompts, of combinations that trainings may have had; "withheld" ones
are of combinations that no training had.
"""

import argparse
import contextlib
import csv
import hashlib
import io
import json
import multiprocessing
import os
import shutil
import statistics
import sys
import tempfile
import time
import unittest.mock
from collections.abc import Iterator
from concurrent.futures import FIRST_COMPLETED, Executor, Future, ProcessPoolExecutor, wait
from pathlib import Path
from typing import Any, NamedTuple

from tqdm import tqdm

from benchmarks.quality.runs import CHARTS, add_jobs, append_rows, require_kernel, rows_of
from benchmarks.quality.toybox_jobs import (
    CHART,
    CONFIG,
    EXACT,
    GPU_CHART,
    MODELS_BESIDE_GUIDANCE,
    RECOGNIZED,
    SAMPLES,
    STEPS,
    TRUTH,
    WORLD,
    Prompt,
    Variant,
    judge_of,
    prompts,
    setup,
    setup_of_samples,
)
from benchmarks.quality.toybox_options import CHARTS as VARIANTS
from threestudio_gaussiandreamer.guidance.text_to_image import cpu_multiplies_bfloat16

KEY = ("variant", "x", "withheld", "index", "seed", "setup", "judge")
LOOKS = ("saturation", "at_limits", "evaluations")
"""Columns that earlier rows lack; evaluations of the 2D model, one per view and prompt."""
COLUMNS = [*KEY, "prompt", "cpu_seconds", "gaussians"]
COLUMNS += [*RECOGNIZED, "clip", "haze", "faint", *LOOKS, *(f"prior_{name}" for name in RECOGNIZED)]
COLUMNS += ["options", "machine", "commit"]
QUICK = {
    "use_timestamp": "false", "name": "toybox", "tag": "run", "system.pages": "false",
    "data.n_test_views": 1, "data.eval_width": 64, "data.eval_height": 64,
    "trainer.val_check_interval": 100000, "trainer.enable_progress_bar": "false",
    "trainer.log_every_n_steps": 10, "system.exporter": "{formats: [ply], save_video: false}",
}  # fmt: skip
"""Options that leave out what isn't measured: pages, video and pictures."""
RUN = f"{QUICK['name']}/{QUICK['tag']}"
"""Where these options put a run."""
MODELS = "system.guidance.pretrained_model_name_or_path"
"""The option from which toybox.yaml takes all models."""
RECORD = "seconds.json"
"""CPU seconds of a kept run, written when it has ended."""

ENVIRONMENT = {"OMP_NUM_THREADS": "1", "MKL_NUM_THREADS": "1", "OMP_WAIT_POLICY": "passive"}
"""Of the processes: one thread."""
CPU = "cpu"
"""In place of a GPU's number."""


class Task(NamedTuple):
    """One run, or one set of pictures."""

    variant: Variant
    prompt: Prompt
    seed: int
    models: str
    keep: Path | None = None
    """Folder of runs that are kept, to be scored again later."""
    gpu: str = CPU

    @property
    def key(self) -> tuple[str, ...]:
        return (*self.made_of, judge_of(self.models))

    @property
    def made_of(self) -> tuple[str, ...]:
        """What identifies the pictures, without the judge."""
        place = (str(int(self.prompt.withheld)), str(self.prompt.index), str(self.seed))
        return (*self.variant.key, *place, self.setup)

    @property
    def setup(self) -> str:
        """What the pictures depend on: the objects, the models, or models and configuration."""
        if self.variant.name == TRUTH:
            return WORLD
        is_run = self.variant.name != SAMPLES
        of_run = setup(self.models, self.variant.config)
        return of_run if is_run else setup_of_samples(self.models)


# ---- in the processes ----------------------------------------------------------------------------


def prepare() -> None:
    """Import the package, limit this process to one thread, and keep its networks loaded."""
    import torch

    from threestudio_gaussiandreamer import register_parts
    from threestudio_gaussiandreamer.models.model_files import keep_loaded

    torch.set_num_threads(1)
    register_parts()
    keep_loaded()


def measure(task: Task) -> dict[str, Any]:
    """Return the row of a task; its messages are shown only if it fails."""
    messages = io.StringIO()
    try:
        with contextlib.redirect_stdout(messages), contextlib.redirect_stderr(messages):
            return row_of(task, measured(task)) | gpu_of(task)
    except Exception as error:
        shown = " | ".join(task.key)
        raise RuntimeError(f"{shown}: {error}\n{messages.getvalue()[-2000:]}") from error


def gpu_of(task: Task) -> dict[str, str]:
    """Return the GPU's name for the column "machine", without seconds; empty for the CPU."""
    if task.gpu == CPU:
        return {}
    import torch

    return {"machine": torch.cuda.get_device_name(), "cpu_seconds": ""}


def measured(task: Task) -> dict[str, float]:
    """Make and score the pictures or the run of a task."""
    from benchmarks.quality import toybox_scores as scores

    text = task.prompt.text
    if task.variant.name == TRUTH:
        return scores.of_truth(task.prompt, task.models)
    if task.variant.name == SAMPLES:
        return scores.of_samples(text, task.variant.x, task.seed, task.models)
    if task.keep:
        return scored(task, kept(task))
    with tempfile.TemporaryDirectory() as folder:
        return scored(task, Path(folder))


def kept(task: Task) -> Path:
    """Return the folder of a kept run, which depends on all of its options."""
    gpu = () if task.gpu == CPU else ("GPU",)
    content = repr((task.made_of, task.variant.options, *gpu)).encode()
    return task.keep / hashlib.blake2b(content, digest_size=8).hexdigest()


def needs_no_run(task: Task) -> bool:
    """Return whether the task's run is kept, or it has none."""
    return task.variant.name in (TRUTH, SAMPLES) or (kept(task) / RECORD).exists()


def scored(task: Task, folder: Path) -> dict[str, float]:
    """Score a run, which is made unless the folder has it."""
    from benchmarks.quality import toybox_scores as scores

    record = folder / RECORD
    if not record.exists():
        shutil.rmtree(folder, ignore_errors=True)  # of a run that was interrupted
        start = time.process_time()
        run(task, folder)
        record.write_text(json.dumps(time.process_time() - start))
    found = scores.of_run(folder / RUN, task.prompt.text, task.models)
    found |= scores.looks_of(folder / RUN, task.prompt)
    steps = int(task.variant.options.get("trainer.max_steps", STEPS))
    found |= {"evaluations": steps * evaluations_per_step(folder / RUN)}
    return found | {"cpu_seconds": json.loads(record.read_text())}


def evaluations_per_step(folder: Path) -> float:
    """Return the mean of the logged evaluations of the score model."""
    (log,) = folder.glob("csv_logs/version_*/metrics.csv")
    with open(log, newline="") as file:
        values = [row.get("train/evaluations") for row in csv.DictReader(file)]
    return statistics.mean(float(value) for value in values if value)


def run(task: Task, folder: Path) -> None:
    """Run the launcher in this process."""
    from threestudio_gaussiandreamer.launch.experiment import main as launch

    options = QUICK | task.variant.options
    options |= {
        "exp_root_dir": folder,
        "seed": task.seed,
        "system.prompt_processor.prompt": task.prompt.text,
        "system.prompt_processor.cache_dir": folder / "embeddings",
    }
    exact = task.variant.name == EXACT
    options |= dict.fromkeys(MODELS_BESIDE_GUIDANCE if exact else (MODELS,), task.models)
    arguments = [f"{key}={value}" for key, value in options.items()]
    with truth_known(task.prompt) if exact else contextlib.nullcontext():
        code = launch(["--config", task.variant.config, "--train", "--gpu", task.gpu, *arguments])
    if code:
        raise RuntimeError(f"the launcher returned {code}")


@contextlib.contextmanager
def truth_known(prompt: Prompt) -> Iterator[None]:
    """Let the exact score load the object, whose texture with baked light fits into no file."""
    from benchmarks.quality.toybox_scores import object_of
    from threestudio_gaussiandreamer.guidance import exact_score

    mesh = object_of(prompt)
    with unittest.mock.patch.object(exact_score, "load_mesh", lambda *args, **options: mesh):
        yield


def row_of(task: Task, found: dict[str, Any]) -> dict[str, Any]:
    """Return the row of a task."""
    numbers = {name: f"{value:.4g}" for name, value in found.items()}
    options = " ".join(f"{key}={value}" for key, value in task.variant.options.items())
    place = dict(zip(KEY, task.key, strict=True)) | {"prompt": task.prompt.text}
    return place | numbers | {"options": options.replace("system.", "")}


# ---- in the command ------------------------------------------------------------------------------


def main() -> None:
    arguments = parse_arguments()
    measure_missing(arguments, tasks(arguments))


def measure_missing(arguments: argparse.Namespace, tasks: Iterator[Task]) -> None:
    """Measure the tasks that ``arguments.chart`` lacks, whose columns are ``arguments.columns``."""
    arguments.out.mkdir(parents=True, exist_ok=True)
    todo = missing(arguments, tasks)
    if arguments.list:
        print("\n".join(" | ".join((*task.key, task.prompt.text)) for task in todo))
        return
    require_kernel()
    os.environ |= ENVIRONMENT
    choose_device(arguments.gpu)
    spawn = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(arguments.jobs, mp_context=spawn, initializer=prepare) as pool:
        failed = work(todo, arguments, pool)
    sys.exit(f"{failed} of {len(todo)} failed" if failed else 0)


def choose_device(gpu: str) -> None:
    """Let the processes see that GPU alone, or the one that CUDA_VISIBLE_DEVICES names already."""
    if gpu == CPU:
        os.environ["CUDA_VISIBLE_DEVICES"] = ""
        return
    import torch

    visible = os.environ.setdefault("CUDA_VISIBLE_DEVICES", gpu)
    if (found := torch.cuda.device_count()) != 1:
        sys.exit(f"--gpu {gpu}: {found} GPUs with CUDA_VISIBLE_DEVICES={visible} in place of one")


def device(text: str) -> str:
    """Parse "cpu" or the number of a GPU."""
    if text != CPU and not text.isdecimal():
        raise argparse.ArgumentTypeError(f"{text!r} is neither cpu nor the number of a GPU")
    return text


def parse_arguments() -> argparse.Namespace:
    parser = argument_parser(__doc__)
    add = parser.add_argument
    add("--charts", nargs="*", choices=VARIANTS, help="in order of priority (default: all)")
    add("--variant", action="append", type=variant, default=[], help='"NAME X KEY=VALUE ..."')
    add("--prompts", nargs="+", choices=("seen", "withheld"), default=["withheld"])
    add("--count", type=int, default=20, help="of prompts of each sort (default: 20)")
    add("--seeds", type=int, nargs="+", default=[0])
    arguments = parsed(parser, (CHART, GPU_CHART))
    arguments.columns = COLUMNS
    if arguments.charts is None:
        arguments.charts = [] if arguments.variant else list(VARIANTS)
    return arguments


def argument_parser(doc: str) -> argparse.ArgumentParser:
    """Return a parser with the options of all benchmarks of runs."""
    parser = argparse.ArgumentParser(description=doc.splitlines()[0])
    add = parser.add_argument
    add("--models", default="toybox", help="toybox, or the folder of an export")
    add("--gpu", type=device, default=CPU, help="its number; its runs have a CSV of their own")
    add("--keep", type=Path, help="folder for the runs; those that it has are only scored")
    add("--only-score", action="store_true", help="make no run that --keep doesn't have")
    add("--seconds", type=float, help="stop after this time; runs under way are given up")
    add("--out", type=Path, default=CHARTS, help="folder of the CSV (default: docs/charts)")
    add("--list", action="store_true", help="only print what would run")
    add_jobs(parser)
    return parser


def parsed(parser: argparse.ArgumentParser, charts: tuple[str, str]) -> argparse.Namespace:
    """Parse the command line; choose the chart of the CPU or that of a GPU."""
    arguments = parser.parse_args()
    arguments.chart = charts[arguments.gpu != CPU]
    if arguments.only_score and not arguments.keep:
        parser.error("--only-score: give the runs' folder as --keep")
    return arguments


def seconds_comparable(out: Path) -> bool:
    """Return whether the CPU seconds of this machine belong to those of the rows in ``out``."""
    wanted = CONFIG["system"]["guidance"]["half_precision_on_cpu"]
    return out.resolve() != CHARTS.resolve() or not wanted or cpu_multiplies_bfloat16()


def variant(text: str) -> Variant:
    """Parse an ad-hoc variant: a name, a number, and options."""
    name, x, *options = text.split()
    return Variant(name, float(x), dict(option.split("=", 1) for option in options))


def tasks(arguments: argparse.Namespace) -> Iterator[Task]:
    """Yield all tasks in order of priority."""
    charts = [list(VARIANTS[name]()) for name in arguments.charts]
    common = arguments.models, arguments.keep, arguments.gpu
    for variants in (arguments.variant, *charts):
        for seed in arguments.seeds:
            for sort in arguments.prompts:
                for prompt in prompts(sort, arguments.count):
                    for one in variants:
                        yield Task(one, prompt, seed, *common)


def unique(items: Iterator[Task]) -> list[Task]:
    """Drop repeated tasks."""
    found: dict[tuple[str, ...], Task] = {}
    for task in items:
        found.setdefault(task.key, task)
    return list(found.values())


def missing(arguments: argparse.Namespace, tasks: Iterator[Task]) -> list[Task]:
    """Return the tasks whose rows aren't in the CSV; with ``--only-score`` those without a run."""
    rows = rows_of(arguments.chart, arguments.out)
    if rows and list(rows[0]) != arguments.columns:
        path = arguments.out / f"{arguments.chart}.csv"
        sys.exit(f"{path} has other columns: give another folder as --out")
    done = {tuple(row[name] for name in KEY) for row in rows}
    todo = [task for task in unique(tasks) if task.key not in done]
    return [task for task in todo if not arguments.only_score or needs_no_run(task)]


def work(todo: list[Task], arguments: argparse.Namespace, pool: Executor) -> int:
    """Measure the tasks side by side and append their rows; return how many failed.

    With ``--seconds`` no run is begun that would take longer than what is left, and the processes
    of those that haven't ended by then are ended.
    """
    end = time.monotonic() + (arguments.seconds or float("inf"))
    queue, running, durations, failed = iter(todo), {}, [0.0], 0
    bar = tqdm(total=len(todo), unit="run", disable=None)
    try:
        while True:
            for task in startable(queue, arguments.jobs - len(running), durations, end):
                running[pool.submit(measure, task)] = task, time.monotonic()
            if not running or time.monotonic() >= end:
                return failed
            left = max(end - time.monotonic(), 0.0) if arguments.seconds else None
            for future in wait(running, left, FIRST_COMPLETED).done:
                task, began = running.pop(future)
                durations.append(time.monotonic() - began)
                failed += not noted(future, arguments)
                bar.update()
    finally:
        if running:  # given up, or an error
            for process in multiprocessing.active_children():
                process.terminate()


def startable(queue: Iterator[Task], free: int, durations: list[float], end: float) -> list[Task]:
    """Take at most ``free`` tasks, unless there isn't the time for a run of median length."""
    if time.monotonic() + statistics.median(durations) > end:
        return []
    return [task for _, task in zip(range(free), queue, strict=False)]


def noted(done: Future, arguments: argparse.Namespace) -> bool:
    """Append the row of a task that has ended; return whether it succeeded."""
    if error := done.exception():
        tqdm.write(str(error), file=sys.stderr)
        return False
    row = done.result()
    if not seconds_comparable(arguments.out):
        row = row | {"cpu_seconds": ""}
    append_rows(arguments.chart, arguments.columns, [row], arguments.out)
    return True


if __name__ == "__main__":
    main()
