"""The index of a run, ``index.html`` in its folder: the viewer, pictures, scores, curves, what the
configuration changes, times, and links to all files. It is static and opens from disk."""

from collections.abc import Iterator
from datetime import datetime
from itertools import groupby
from pathlib import Path
from typing import Any

from ..core.files import atomic_file, json_text
from ..metrics import MULTI_FACE_NOTE
from .config_changes import config_changes
from .curves import number, read_curves, svg
from .run_files import RunFiles, read_json, read_text, step_of
from .static_page import address, backdrop_style, document, element, link, media, section, table

NAME = "index.html"
CURVES = {
    "dB": "dB to the truth",
    "held_out/psnr": "dB on held-out views",
    "loss": "loss",
    "gaussians": "Gaussians",
}
"""Columns of the logs and what they are called."""
SCORES = {"psnr": "dB", "ssim": "SSIM", "multi_face": "multi-face", "gaussians": "Gaussians"}
MAX_FILES, MAX_COMMANDS = 5000, 10
VALIDATION_PICTURES = 8
TIMES = "times.json"
"""What the launcher notes of each stage: its name, when it began, and its seconds."""


def write_index(folder: Path) -> Path:
    """Write the index of a run, from what there is; returns its path.

    Raises:
        UserError: it can't be written.
    """
    run = RunFiles(folder)
    path = folder / NAME
    content = document(run.prompt, _parts(run)).encode(errors="replace")
    with atomic_file(path, durable=False) as file:
        file.write(content)
    return path


def _parts(run: RunFiles) -> Iterator[str]:
    yield element("h1", run.prompt)
    yield element("p", run.folder.name)
    yield section("Downloads", _downloads(run))
    yield section("In 3D", _viewer(run))
    yield section("Turntable", _turntable(run))
    yield section("Scores on held-out views", _scores(run))
    yield section("Curves", *_curves(run))
    yield section("Pictures", *_pictures(run))
    yield section("Command", *_commands(run))
    changes = config_changes(run.folder / "configs")
    yield section(
        "What differs from the base configuration", table(("key", "base", "run"), changes)
    )
    yield section("Times", _times(run))
    yield section("Files", *_files(run.folder))


def _commands(run: RunFiles) -> Iterator[str]:
    """Yield the command lines of the run and of those that have gone on with it."""
    lines = read_text(run.folder / "cmd.txt").splitlines()
    yield from (f"<p>{element('code', line)}</p>" for line in lines[-MAX_COMMANDS:])


def _downloads(run: RunFiles) -> str:
    """Return a list of the export's files, the page and the meshes among them, and the video."""
    exported = (path for path in run.export.iterdir() if path.is_file()) if run.export else ()
    items = [_file(path, run.folder, path.name) for path in [*sorted(exported), *_videos(run)[-1:]]]
    return f'<ul class="downloads">{"".join(items)}</ul>' if items else ""


def _videos(run: RunFiles) -> list[Path]:
    return sorted(run.save.glob("it*-test.mp4"), key=step_of)


def _viewer(run: RunFiles) -> str:
    page = run.export and run.export / "view.html"
    if not page or not page.is_file():
        return ""
    where = address(page, run.folder)
    options = {"title": "the cloud in 3D", "loading": "lazy", "allow": "fullscreen"}
    frame = element("iframe", "", src=where, **options)
    return frame + element("a", "open in a window of its own", href=where)


def _turntable(run: RunFiles) -> str:
    """Return the video of the latest test views, or the animated picture."""
    videos = _videos(run)
    if videos:
        where = address(videos[-1], run.folder)
        return media("video", src=where, controls="", loop="", muted="", width="384") + "</video>"
    return "".join(_figure(path, run) for path in sorted(run.save.glob("it*-test.webp"))[-1:])


def _scores(run: RunFiles) -> str:
    rows = []
    for key in ("prior", "result"):
        found = run.scores.get(key)
        if isinstance(found, dict):
            rows.append([key, *(_shown(found.get(name), name) for name in SCORES)])
    note = element("p", MULTI_FACE_NOTE) if rows else ""
    return table(("", *SCORES.values()), rows) + note


def _shown(value: Any, name: str = "") -> str:
    if isinstance(value, (int, float)) and name == "multi_face":
        return f"{100 * value:.0f} %"
    if isinstance(value, (int, float)):
        return number(value)
    return str("–" if value is None else value)


def _curves(run: RunFiles) -> Iterator[str]:
    curves = read_curves(run.folder, list(CURVES))
    yield from (f"<figure>{svg(curves[name], CURVES[name])}</figure>" for name in curves)


def _pictures(run: RunFiles) -> Iterator[str]:
    """Yield the comparison with the truth, the poster, the prior and the last validations."""
    fixed = [run.save / "held_out" / "compare.png", run.save / "prior" / "turntable.gif"]
    poster = [run.export / "poster.png"] if run.export else []
    validations = sorted(run.save.glob("it*-*.png"), key=step_of)[-VALIDATION_PICTURES:]
    for path in (*poster, *fixed, *validations):
        if path.is_file():
            yield _figure(path, run)


def _figure(path: Path, run: RunFiles) -> str:
    where = address(path, run.folder)
    picture = media("img", src=where, alt=path.name, loading="lazy", **backdrop_style(path))
    caption = element("figcaption", str(path.relative_to(run.save)))
    return f'<figure><a href="{where}">{picture}</a>{caption}</figure>'


def _times(run: RunFiles) -> str:
    rows = [
        (str(entry.get("stage")), str(entry.get("began")), f"{_shown(entry.get('seconds'))} s")
        for entry in read_json(run.folder / TIMES, list)
        if isinstance(entry, dict)
    ]
    training = {"seconds": "training alone", "cpu_seconds": "processor time of training"}
    rows += [
        (text, "", f"{_shown(run.scores[name])} s")
        for name, text in training.items()
        if name in run.scores
    ]
    return table(("stage", "began", "time"), rows)


def _files(folder: Path) -> Iterator[str]:
    """Yield a list of links for every folder at the top, closed where it is long."""
    files = sorted(path for path in folder.rglob("[!.]*") if path.is_file() and path.name != NAME)
    for name, group in groupby(files[:MAX_FILES], lambda path: path.relative_to(folder).parts[0]):
        items = [_file(path, folder) for path in group]
        text = f"{name} ({len(items)})" if (folder / name).is_dir() else name
        yield f"<details>{element('summary', text)}<ul>{''.join(items)}</ul></details>"
    if len(files) > MAX_FILES:
        yield element("p", f"and {len(files) - MAX_FILES} more files")


def _file(path: Path, folder: Path, name: str = "") -> str:
    text = (name or str(path.relative_to(folder))).encode(errors="replace").decode()
    return f"<li>{link(path, folder, text)} {element('small', _size(path))}</li>"


def _size(path: Path) -> str:
    try:
        size = float(path.stat().st_size)
    except FileNotFoundError:  # another stage has replaced it since the folder was listed
        return ""
    return f"{size / 1e6:.1f} MB" if size >= 1e6 else f"{size / 1e3:.1f} kB"


def note_time(folder: Path, stage: str, began: datetime, seconds: float) -> None:
    """Append a finished stage to the times of a run.

    Raises:
        UserError: the file can't be written.
    """
    times = read_json(folder / TIMES, list)
    entry = {
        "stage": stage,
        "began": began.isoformat(sep=" ", timespec="seconds"),
        "seconds": round(seconds, 1),
    }
    with atomic_file(folder / TIMES, durable=False) as file:
        file.write(json_text([*times, entry], indent=1).encode())
