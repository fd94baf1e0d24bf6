"""The index of a run and the gallery of a folder of runs, ``index.html`` in them: static pages that
open from disk."""

import csv
import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from datetime import datetime
from itertools import groupby
from pathlib import Path
from typing import Any, Optional

from ..core.errors import UserError
from ..core.files import json_text, write_file
from ..core.logs import warn
from ..metrics import MULTI_FACE_NOTE
from .page import address, decibels, write_static
from .render import backdrop_of_file, hex_color
from .run_files import RunFiles, is_run, read_json, read_text, read_yaml, step_of

NAME = "index.html"
CURVES = {
    "dB": "dB to the truth",
    "held_out/psnr": "dB on held-out views",
    "loss": "loss",
    "gaussians": "Gaussians",
}
"""Columns of the logs and what they are called."""
SCORES = {"psnr": "dB", "ssim": "SSIM", "multi_face": "multi-face", "gaussians": "Gaussians"}
MAX_COMMANDS, MAX_POINTS, VALIDATION_PICTURES = 10, 400, 8
TIMES = "times.json"
"""What the launcher notes of each stage: its name, when it began, and its seconds."""
USERS = "data system trainer checkpoint name tag seed description exp_root_dir use_timestamp"
"""Keys at the top level that users set; the others are computed."""
MAX_DEPTH = 3
"""Folders between the gallery's and a run's: an experiment's, and a sweep's above it."""
OWN_PAGE = "script-src 'none'; object-src 'none'"
"""Is in the head of every page of this module."""


def write_index(folder: Path) -> Path:
    """Write the index of a run, from what there is; returns its path."""
    run, path = RunFiles(folder), folder / NAME
    videos = sorted(run.save.glob("it*-test.mp4"), key=step_of)
    exported = sorted(filter(Path.is_file, run.export.iterdir())) if run.export else []
    page = run.export and run.export / "view.html"
    animations = sorted(run.save.glob("it*-test.webp"))[-1:]
    scores = [
        [key, *(_shown(run.scores[key].get(name), name) for name in SCORES)]
        for key in ("prior", "result")
        if isinstance(run.scores.get(key), dict)
    ]
    curves = read_curves(folder, list(CURVES))
    write_static(
        path,
        "run.html",
        title=run.prompt,
        folder=folder.name,
        downloads=[_file(path, folder, path.name) for path in [*exported, *videos[-1:]]],
        viewer=page and page.is_file() and address(page, folder),
        video=videos and address(videos[-1], folder),
        animation=animations and _picture(animations[0], run),
        scores_head=("", *SCORES.values()),
        scores=scores,
        scores_note=MULTI_FACE_NOTE,
        curves=[drawn(curves[name], CURVES[name]) for name in curves],
        pictures=[_picture(path, run) for path in _pictures(run)],
        commands=read_text(folder / "cmd.txt").splitlines()[-MAX_COMMANDS:],
        changes=config_changes(folder / "configs"),
        times=list(_times(run)),
        groups=_files(folder),
    )
    return path


def number(value: float) -> str:
    """Format a number with five digits, or all that are before its point."""
    return f"{value:,.0f}" if abs(value) >= 1e4 else f"{value:.5g}"


def _shown(value: Any, name: str = "") -> str:
    if isinstance(value, (int, float)):
        return f"{100 * value:.0f} %" if name == "multi_face" else number(value)
    return str("–" if value is None else value)


def _pictures(run: RunFiles) -> list[Path]:
    """List the poster, the comparison with the truth and the last validations."""
    truth = run.save / "held_out" / "compare.png"
    poster = [run.export / "poster.png"] if run.export else []
    validations = sorted(run.save.glob("it*-*.png"), key=step_of)[-VALIDATION_PICTURES:]
    return [path for path in (*poster, truth, *validations) if path.is_file()]


def _picture(path: Path, run: RunFiles, page_folder: Optional[Path] = None) -> dict[str, Any]:
    """Return what a page shows of a picture, and a colour on which its object doesn't vanish."""
    color, caption = backdrop_of_file(path), str(path.relative_to(run.save))
    shown = {"href": address(path, page_folder or run.folder), "name": path.name}
    return shown | {"caption": caption, "color": color and hex_color(color)}


def _times(run: RunFiles) -> Iterator[tuple[str, str, str]]:
    for entry in read_json(run.folder / TIMES, list):
        if isinstance(entry, dict):
            seconds = _shown(entry.get("seconds"))
            yield str(entry.get("stage")), str(entry.get("began")), f"{seconds} s"
    training = {"seconds": "training alone", "cpu_seconds": "processor time of training"}
    for name, text in training.items():
        if name in run.scores:
            yield text, "", f"{_shown(run.scores[name])} s"


def _files(folder: Path) -> Iterator[tuple[str, list[dict[str, Any]]]]:
    """Yield the files of every folder at the top."""
    files = sorted(path for path in folder.rglob("[!.]*") if path.is_file() and path.name != NAME)
    for name, group in groupby(files, lambda path: path.relative_to(folder).parts[0]):
        items = [_file(path, folder) for path in group]
        yield f"{name} ({len(items)})" if (folder / name).is_dir() else name, items


def _file(path: Path, folder: Path, name: str = "") -> dict[str, Any]:
    text, size = name or str(path.relative_to(folder)), 0
    with suppress(FileNotFoundError):  # another stage has replaced it since the folder was listed
        size = path.stat().st_size
    return {"href": address(path, folder), "text": text, "size": size}


def note_time(folder: Path, stage: str, began: datetime, seconds: float) -> None:
    """Append a finished stage to the times of a run; raises UserError if it can't be written."""
    entry = {"stage": stage, "began": began.isoformat(sep=" ", timespec="seconds")}
    times = [*read_json(folder / TIMES, list), entry | {"seconds": round(seconds, 1)}]
    write_file(folder / TIMES, json_text(times, indent=1), durable=False)


def config_changes(folder: Path) -> list[tuple[str, Any, Any]]:
    """Return key, value in the base file and value in the run, for those that differ."""
    base = dict(leaves(read_yaml(folder / "raw.yaml")))
    return [
        (key, base.get(key, "–"), value)
        for key, value in leaves(read_yaml(folder / "parsed.yaml"))
        if key.partition(".")[0] in USERS.split()
        and "${" not in str(base.get(key))  # which refers to another value
        and (key not in base or base[key] != value)
    ]


def leaves(content: Any, prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Yield the dotted key and the value of everything that isn't a mapping."""
    for name, value in content.items():
        if isinstance(value, Mapping) and value:
            yield from leaves(value, f"{prefix}{name}.")
        else:
            yield f"{prefix}{name}", value


Curve = list[tuple[float, float]]
"""Steps and values, by step."""


def read_curves(folder: Path, names: Sequence[str]) -> dict[str, Curve]:
    """Return the columns of a run's CSV logs with two or more finite values; later logs win."""
    values: dict[str, dict[float, float]] = {name: {} for name in names}
    logs = folder.glob("csv_logs/version_*/metrics.csv")
    for path in sorted(logs, key=lambda path: (len(path.parent.name), path.parent.name)):
        # a page without a curve is better than none
        with (
            suppress(OSError, csv.Error),
            open(path, newline="", encoding="utf-8", errors="replace") as file,
        ):
            for row in csv.DictReader(file):
                for name in names:
                    with suppress(KeyError, TypeError, ValueError):
                        step, value = float(row["step"]), float(row[name])
                        if math.isfinite(step) and math.isfinite(value):
                            values[name][step] = value
    return {name: sorted(found.items()) for name, found in values.items() if len(found) > 1}


def drawn(curve: Curve, title: str) -> dict[str, Any]:
    """Return a curve over steps for the page, logarithmic for several powers of ten: its points in
    the unit square, and the lowest and highest value, first and last step.
    """
    curve = curve[:: -(-len(curve) // MAX_POINTS)]
    steps, values = zip(*curve, strict=True)
    low, high = min(values), max(values)
    logarithmic = low > 0 and high > 100 * low
    heights = [math.log10(value) for value in values] if logarithmic else values
    points = zip(_in_unit(steps), _in_unit(heights), strict=True)
    return {
        "title": f"{title}, logarithmic" if logarithmic else title,
        "points": " ".join(f"{x:.4f},{y:.4f}" for x, y in points),
        "ends": [number(end) for end in (low, high, steps[0], steps[-1])],
    }


def _in_unit(values: Sequence[float]) -> list[float]:
    """Map the range of the values to 0 to 1; a constant lies in the middle."""
    low, span = min(values), max(values) - min(values)
    return [(value - low) / span if span else 0.5 for value in values]


def write_gallery(folder: Path) -> Path:
    """Write the gallery of a folder's runs, and their own indices, if possible; return its path."""
    patterns = ["/".join(["*"] * depth) for depth in range(1, MAX_DEPTH + 1)]
    found = [path for pattern in patterns for path in folder.glob(pattern) if is_run(path)]
    if not found:
        raise UserError(
            f"{str(folder)!r} holds no run: expected the folder of a run, with "
            f"configs/parsed.yaml, or one above such folders, up to {MAX_DEPTH} levels"
        )
    for run in found:
        try:
            write_index(run)
        except UserError as error:
            warn(str(error))
    path = folder / NAME
    if path.exists() and OWN_PAGE not in path.read_bytes()[:1000].decode(errors="replace"):
        advice = "so it isn't replaced: move it"
        raise UserError(f"{str(path)!r} isn't a page of this package, {advice}")
    cards = [_card(RunFiles(run), folder) for run in sorted(found)]
    title = f"{len(cards)} runs in {folder.resolve().name}"
    write_static(path, "gallery.html", title=title, cards=cards)
    return path


def _card(run: RunFiles, folder: Path) -> dict[str, Any]:
    index, picture = run.folder / NAME, run.picture
    return {
        "href": address(index if index.is_file() else run.folder, folder),
        "picture": picture and _picture(picture, run, folder),
        "texts": (run.prompt, decibels(run.psnr("result")), str(run.folder.relative_to(folder))),
    }
