"""The tables of the rasteriser in docs/rasteriser.md and reports/speed.md, from
docs/charts/rasteriser.csv and, in benchmarks/results, splatting.csv and gpu-<device>.json.
"""

import functools
import json
from collections.abc import Callable
from pathlib import Path

from benchmarks.markdown import markdown, read
from benchmarks.splatting.gpu_kernels import COMPARISON_AIM, beyond_aim
from benchmarks.splatting.gpu_training import REST_AIM

ROOT = Path(__file__).resolve().parents[2]
ACCURACY, SPEED = ROOT / "docs/charts/rasteriser.csv", ROOT / "benchmarks/results/splatting.csv"
SCENES = ("initial", "trained", "fog", "needles", "deep", "near plane")
PRESETS = {"fast": "1/255", "balanced": "1/1024", "accurate": "1/65536"}
TITLES = {"train_that_waited": "the earlier state"}
"""Sections of a GPU's report that aren't called by the name of an argument."""
THRESHOLDS = ("1/64", "1/255", "1/1024", "1/4096", "1/16384", "1/65536", "0")
CONTENDERS = {
    "cpu": "CPU kernel",
    "cpu-v3": "CPU kernel, AVX2 build",
    "torch": "plain torch",
    "gsplat": "gsplat's plain torch",
    "prototype": "AVX-512 prototype (intrinsics)",
}


def presets() -> str:
    """Return PSNR of each preset on each scene, gradient error and time on a trained cloud."""
    return accuracy("preset", {f"`{name}`": name for name in PRESETS}, PRESETS)


def thresholds() -> str:
    """Return the same for each smallest alpha."""
    return accuracy("alpha_min", {name: name for name in THRESHOLDS})


def accuracy(group: str, settings: dict[str, str], alphas: dict[str, str] | None = None) -> str:
    """Return a table of settings at 512²: PSNR on each scene, gradient error and time of `trained`.

    Args:
        group: of the settings in the CSV.
        settings: name in the table to name in the CSV.
        alphas: smallest alpha of each setting, where its name doesn't tell.
    """
    rows = [row for row in read(ACCURACY) if (row["size"], row["group"]) == ("512", group)]
    cells = {(row["setting"], row["scene"]): row for row in rows}
    fastest = milliseconds(fast_preset())
    table = []
    for title, setting in settings.items():
        trained = cells[setting, "trained"]
        psnr = (f"{float(cells[setting, scene]['psnr']):.1f}" for scene in SCENES)
        ratio = f"{milliseconds(trained) / fastest:.1f}"
        alpha = [alphas[setting]] if alphas else []
        table.append((title, *alpha, *psnr, f"{float(trained['l2']):.1%}", ratio))
    names = ("preset", "smallest alpha") if alphas else ("smallest alpha",)
    return markdown((*names, *SCENES, "worst gradient, trained", "time, trained"), table)


def fast_preset() -> dict[str, str]:
    """Return the row that times are relative to."""
    place = ("512", "preset", "fast", "trained")
    columns = ("size", "group", "setting", "scene")
    return next(row for row in read(ACCURACY) if tuple(row[c] for c in columns) == place)


def milliseconds(row: dict[str, str]) -> float:
    """Return the time of forward and backward."""
    return float(row["forward_ms"]) + float(row["backward_ms"])


def contenders() -> str:
    """Return milliseconds of forward and backward for 100,000 Gaussians, and peak memory."""
    rows = {
        (row["contender"], row["size"], row["threads"]): row
        for row in read(SPEED)
        if row["gaussians"] == "100000"
    }
    threads = sorted({key[2] for key in rows}, key=int)
    places = [(size, count) for size in ("512", "1024") for count in threads]
    table = []
    for contender, title in CONTENDERS.items():
        found = [rows.get((contender, *place)) for place in places]
        cells = [f"{float(row['both_ms']):.1f}" if row else "" for row in found]
        memory = [float(row["memory_mb"]) for row in found if row]
        table.append((title, *cells, f"{max(memory):.0f} MB"))
    head = [f"{size}², {count} thread{'s' * (count != '1')}" for size, count in places]
    return f"{conditions(list(rows.values()))}\n\n{markdown(('', *head, 'peak memory'), table)}"


def conditions(rows: list[dict[str, str]]) -> str:
    """Return what was timed, on which machine and under which load."""
    machine = SPEED.read_text().partition("\n")[0].removeprefix("# ")
    loads = sorted(float(row["load"]) for row in rows)
    return (
        "Milliseconds of forward and backward of one view, 100,000 Gaussians, preset `fast` "
        f"({machine}; system load {loads[0]} to {loads[-1]}):"
    )


def speedup() -> str:
    """Return how many times faster the CPU kernel is than gsplat's plain torch, 512²."""
    ms = {
        (row["threads"], row["contender"]): float(row["both_ms"])
        for row in read(SPEED)
        if (row["gaussians"], row["size"]) == ("100000", "512")
    }
    threads = sorted({key[0] for key in ms}, key=int)
    times = " / ".join(f"{ms[n, 'gsplat'] / ms[n, 'cpu']:.0f}" for n in threads)
    return f"{times} times faster ({' / '.join(threads)} threads)"


def gpu() -> str:
    """Return what each run of ``gpu_check`` found, one column per GPU."""
    files = sorted((ROOT / "benchmarks/results").glob("gpu-*.json"))
    runs = [json.loads(path.read_text()) for path in files]
    rows: dict[str, Callable[[dict], str]] = {
        "image, largest relative error": lambda run: f"{max(_errors(run, 'image')):.0e}",
        "gradients, largest relative error": lambda run: f"{max(_errors(run, 'gradient')):.0e}",
        "plain torch in float32: image, gradients": lambda run: (
            "{image:.0e}, {gradient:.0e}".format(**run["correct"]["fallback"])
        ),
        "the same bits again": lambda run: "yes" if all(_errors(run, "same_bits")) else "no",
        "compute-sanitizer (memcheck, racecheck)": _sanitized,
        "first image with an empty cache, with a filled one": lambda run: (
            f"{run['compile']['first']:.1f} s, {run['compile']['later']:.2f} s"
        ),
        f"comparison at the first use (aim: {COMPARISON_AIM:g} s)": (
            lambda run: _comparison(run["compile"]["comparison"])
        ),
        "what it adds to the first image with a filled cache": lambda run: (
            f"{run['compile']['compared'] - run['compile']['later']:.3f} s"
        ),
    }
    for name in (*PRESETS, "gsplat"):
        rows[f"forward and backward, {name}"] = functools.partial(_bench, name)
    rows |= {
        "times faster than gsplat (fast)": lambda run: (
            f"{run['bench']['times_faster_than_gsplat']:.2f}"
        ),
        "one view of 1,000,000 Gaussians, balanced": functools.partial(_bench, "large"),
        "pruning 100,000 to 25,000, twice": lambda run: (
            " and ".join(f"{seconds:.1f}" for seconds in run["prune"]["seconds"]) + " s"
        ),
    }
    rows |= _training_rows() | {"commits of the sections": _commits}
    table = [(title, *(_measured(cell, run) for run in runs)) for title, cell in rows.items()]
    return markdown(("", *(run["device"] for run in runs)), table)


def _training_rows() -> dict[str, Callable[[dict], str]]:
    rows: dict[str, Callable[[dict], str]] = {}
    for name, title in {"default": "", "lowmem": ", low memory"}.items():
        rows[f"training step{title}: all; U-Net, VAE, the rest"] = functools.partial(_step, name)
    return rows | {
        f"the rest over the U-Net (aim: {_percent(REST_AIM, 0)}): default, low memory": _rest,
        "training step without networks": lambda run: (
            f"{run['train']['default']['empty_networks']['ms_per_step']:.1f} ms"
        ),
        "that step over the U-Net's time": lambda run: (
            f"{run['train']['default']['empty_step_over_unet']:.2f}"
        ),
        "waits for the GPU in a step": lambda run: str(len(run["train"]["default"]["waits"])),
        "an earlier state that waited": lambda run: "{ms_per_step:.1f} ms, {count} waits".format(
            **run["train_that_waited"], count=len(run["train_that_waited"]["waits"])
        ),
        "a run of `demo.yaml`": lambda run: (
            "{seconds:.0f} s, {ms_per_step:.1f} ms a step, {psnr:.2f} dB".format(
                **run["demos"]["demo.yaml"]
            )
        ),
        "a run of `toybox.yaml`": lambda run: "{seconds:.0f} s, {ms_per_step:.1f} ms a step".format(
            **run["demos"]["toybox.yaml"]
        ),
    }


def _measured(cell: Callable[[dict], str], run: dict) -> str:
    """Return a cell; a section that failed or was skipped lacks its keys."""
    try:
        return cell(run)
    except KeyError:
        return "not measured"


def _errors(run: dict, name: str) -> list[float]:
    return [error[name] for error in run["correct"]["relative_errors"].values()]


def _sanitized(run: dict) -> str:
    tools = {name: run["sanitize"][name] for name in ("memcheck", "racecheck")}
    return "clean" if all("clean" in tool for tool in tools.values()) else json.dumps(tools)


def _comparison(found: dict) -> str:
    draws, beyond = found["draws"], beyond_aim(found["seconds"])
    return f"{found['seconds']:.3f} s for {draws} draw{'s' * (draws != 1)}" + (
        f", {beyond['beyond_aim']} beyond the aim" if beyond else ""
    )


def _rest(run: dict) -> str:
    steps = (run["train"][name] for name in ("default", "lowmem"))
    return ", ".join(_percent(step["other_ms"] / step["unet_ms"], 1) for step in steps)


def _percent(share: float, digits: int) -> str:
    return f"{100 * share:.{digits}f} %"


def _commits(run: dict) -> str:
    """Return the sections that ran at each commit."""
    sections: dict[str, list[str]] = {}
    for name, section in run.items():
        if isinstance(section, dict) and "machine" in section:
            commit = section["machine"].rpartition("commit ")[2]
            sections.setdefault(commit, []).append(TITLES.get(name, name))
    return "; ".join(f"`{commit}`: {', '.join(names)}" for commit, names in sections.items())


def _step(name: str, run: dict) -> str:
    found = run["train"][name]
    parts = ", ".join(f"{found[part]:.1f}" for part in ("unet_ms", "vae_ms", "other_ms"))
    return f"{found['ms_per_step']:.1f} ms; {parts} ms; {found['peak_gb']:.1f} GiB"


def _bench(name: str, run: dict) -> str:
    found = run["bench"][name]
    return f"{found['ms']:.2f} ms, {found['mb']:.0f} MB"
