"""The gallery of a folder of runs, ``index.html`` in it: a picture, the prompt and the scores of
each, with a link to its own index."""

from pathlib import Path

from ..core.errors import UserError
from ..core.files import atomic_file
from ..core.logs import warn
from .page import decibels
from .run_files import RunFiles, is_run, step_of
from .run_index import NAME, write_index
from .static_page import address, backdrop_style, document, element, is_own_page, media

MAX_DEPTH = 3
"""Folders between the gallery's and a run's: an experiment's, and a sweep's above it."""


def runs_below(folder: Path) -> list[RunFiles]:
    """Find the runs in a folder, by path."""
    patterns = ["/".join(["*"] * depth) for depth in range(1, MAX_DEPTH + 1)]
    found = [path for pattern in patterns for path in folder.glob(pattern) if is_run(path)]
    return [RunFiles(path) for path in sorted(found)]


def write_gallery(folder: Path) -> Path:
    """Write the gallery of the runs in a folder, and their own indices; returns its path.

    Where a run's index can't be written, a warning is given, and its card leads to its folder.

    Raises:
        UserError: there is no run in the folder, or the gallery can't be written.
    """
    runs = runs_below(folder)
    if not runs:
        raise UserError(
            f"{str(folder)!r} holds no run: expected the folder of a run, with "
            f"configs/parsed.yaml, or one above such folders, up to {MAX_DEPTH} levels"
        )
    for run in runs:
        try:
            write_index(run.folder)
        except UserError as error:
            warn(str(error))
    path = folder / NAME
    if path.exists() and not is_own_page(path):
        raise UserError(
            f"{str(path)!r} isn't a page of this package, so it isn't replaced: move it"
        )
    cards = "".join(_card(run, folder) for run in runs)
    title = f"{len(runs)} runs in {folder.resolve().name}"
    parts = [element("h1", title), f'<div class="cards">{cards}</div>']
    with atomic_file(path, durable=False) as file:
        file.write(document(title, parts).encode(errors="replace"))
    return path


def _card(run: RunFiles, folder: Path) -> str:
    texts = [run.prompt, decibels(run.psnr("result")), str(run.folder.relative_to(folder))]
    lines = "".join(element("div", text) for text in texts if text)
    index = run.folder / NAME
    where = address(index if index.is_file() else run.folder, folder)
    return f'<a href="{where}">{_picture(run, folder)}{lines}</a>'


def _picture(run: RunFiles, folder: Path) -> str:
    """Return the poster of a run, or else a picture of its test views."""
    poster = [run.export / "poster.png"] if run.export else []
    views = sorted(run.save.glob("it*-test/0.png"), key=lambda path: step_of(path.parent))
    found = [path for path in (*poster, *reversed(views)) if path.is_file()]
    if not found:
        return ""
    return media(
        "img", src=address(found[0], folder), alt="", loading="lazy", **backdrop_style(found[0])
    )
