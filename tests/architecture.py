"""Draw the package's rooms, rings and the path of a step: ``python -m tests.architecture``.

Reads the source with :mod:`ast` and writes ``docs/images/architecture.svg`` and the tables between
the markers of ``docs/architecture.md``; ``tests/test_structure.py`` fails if either is stale.
"""

import ast
import functools
import re
import textwrap
from collections.abc import Iterator
from html import escape
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).resolve().parents[1]
NAME = "threestudio_gaussiandreamer"
PACKAGE = ROOT / NAME
PICTURE = ROOT / "docs/images/architecture.svg"
PAGE = ROOT / "docs/architecture.md"


class Ring(NamedTuple):
    """A layer of the package; its rooms import from it and from the rings before it."""

    name: str
    color: str
    rooms: tuple[str, ...]


RINGS = (
    Ring(
        "0 maths",
        "#dbeafe",
        ("core", "gaussians", "formats", "splatting", "diffusion", "meshes", "cameras", "metrics"),
    ),
    Ring("1 host", "#dcfce7", ("host", "models")),
    Ring("2 parts", "#fef9c3", ("prompts", "priors", "guidance", "surface", "exporters")),
    Ring("3 training", "#ffedd5", ("training", "prune", "view", "convert")),
    Ring("4 programs", "#fee2e2", ("launch", "farm", "evaluation", "evaluate", "toybox")),
)


class Step(NamedTuple):
    """A function on the path from the command line to a training step."""

    module: str
    function: str
    does: str


STEPS = (
    Step("launch/experiment.py", "main", "parse arguments, load and check the configuration"),
    Step("launch/run.py", "Run", "build data module, system and trainer, hold the run folder"),
    Step("training/data.py", "GaussianDreamerDataModule", "draw the cameras of step k"),
    Step("training/system.py", "training_step", "render, score, sum the losses, backward"),
    Step("training/renderer.py", "forward", "convert host cameras to OpenCV, composite"),
    Step("splatting/api.py", "rasterize", "validate, choose a backend, splat"),
    Step("guidance/base.py", "ScoreDistillation", "encode, add noise, predict, weigh, clip"),
    Step("diffusion/sds.py", "add_noise", "the formulas of score distillation"),
    Step("training/density.py", "DensityControl", "clone, split and drop Gaussians after the step"),
    Step("core/checkpoint_file.py", "save_file", "write a checkpoint atomically"),
)

WIDTH, MARGIN, BAND, BOX, GAP = 1000, 16, 96, 64, 10


def room_of(path: Path) -> str:
    """Return the folder, or the top-level module, that a source file belongs to."""
    return path.relative_to(PACKAGE).with_suffix("").parts[0]


def sources() -> list[Path]:
    """Return every Python file of the package except its own ``__init__``."""
    return [path for path in sorted(PACKAGE.rglob("*.py")) if path != PACKAGE / "__init__.py"]


@functools.cache
def modules() -> frozenset[str]:
    """Return the absolute names of the package's modules and folders."""
    paths = [path.relative_to(ROOT).with_suffix("") for path in sources()]
    return frozenset(".".join(p.parts) for path in paths for p in (path, path.parent))


def ring_of() -> dict[str, int]:
    """Map each room to the index of its ring."""
    return {room: index for index, ring in enumerate(RINGS) for room in ring.rooms}


def imports(path: Path) -> Iterator[tuple[str, bool]]:
    """Yield (absolute module, whether at module level) for every import statement of a file."""
    tree = ast.parse(path.read_text())
    top_level = {id(node) for node in tree.body}
    for node in ast.walk(tree):
        yield from ((name, id(node) in top_level) for name in imported(node, path))


def imported(node: ast.AST, path: Path) -> list[str]:
    """Return the absolute modules that a statement of the file ``path`` imports."""
    if isinstance(node, ast.Import):
        return [alias.name for alias in node.names]
    if not isinstance(node, ast.ImportFrom):
        return []
    package = [NAME, *path.relative_to(PACKAGE).parent.parts]
    base = package[: len(package) - node.level + 1] if node.level else []
    module = ".".join([*base, *filter(None, [node.module])])
    # "from .. import x" names a room, a module, or a name of the package itself
    names = {f"{module}.{alias.name}" for alias in node.names}
    return sorted(names & modules() or {module} - {NAME})


def arrows() -> dict[tuple[str, str], int]:
    """Count the import statements from one room to another."""
    found: dict[tuple[str, str], int] = {}
    for path in sources():
        for name, _ in imports(path):
            pair = (room_of(path), name.split(".")[1] if name.startswith(NAME + ".") else "")
            if pair[1] and pair[0] != pair[1]:
                found[pair] = found.get(pair, 0) + 1
    return found


def purpose(room: str) -> str:
    """Return the first sentence of a room's docstring."""
    folder = PACKAGE / room
    text = (folder / "__init__.py" if folder.is_dir() else folder.with_suffix(".py")).read_text()
    words = " ".join((ast.get_docstring(ast.parse(text)) or "").split("\n\n")[0].split())
    return re.split(r"(?<=\.) ", words)[0].rstrip(".").replace("``", "")


def label(room: str) -> str:
    return f"{room}/" if (PACKAGE / room).is_dir() else f"{room}.py"


def places() -> dict[str, tuple[float, float, float]]:
    """Return left, top and width of each room's box; ring 0 is the lowest band."""
    found = {}
    for index, ring in enumerate(reversed(RINGS)):
        left, top = MARGIN + 108, MARGIN + index * (BAND + GAP) + (BAND - BOX) / 2
        width = (WIDTH - left - MARGIN - GAP * len(ring.rooms)) / len(ring.rooms)
        for i, room in enumerate(ring.rooms):
            found[room] = (left + i * (width + GAP), top, width)
    return found


def svg() -> str:
    """Return the picture: a band per ring, a box per room, an arrow per import between rings, and
    the path.
    """
    height = MARGIN + len(RINGS) * (BAND + GAP) + 22 * ((len(STEPS) + 1) // 2) + 40
    shapes = [*_bands(), *_arrows(), *_boxes(), *_legend(height)]
    style = "text{font-family:Helvetica,Arial,sans-serif;fill:#111}"
    head = (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {height}" '
        f'width="{WIDTH}" height="{height}"><style>{style}</style>'
        f'<rect width="{WIDTH}" height="{height}" fill="#fff"/>'
    )
    return "\n".join([head, *shapes, "</svg>", ""])


def _text(x: float, y: float, words: str, size: int = 12, extra: str = "") -> str:
    return f'<text x="{x:.0f}" y="{y:.0f}" font-size="{size}" {extra}>{escape(words)}</text>'


def _bands() -> Iterator[str]:
    for index, ring in enumerate(reversed(RINGS)):
        y = MARGIN + index * (BAND + GAP)
        yield (
            f'<rect x="{MARGIN}" y="{y}" width="{WIDTH - 2 * MARGIN}" height="{BAND}" rx="8" '
            f'fill="{ring.color}"/>'
        )
        yield _text(MARGIN + 10, y + BAND / 2 + 5, ring.name, 14, 'font-weight="bold"')


def _arrows() -> Iterator[str]:
    at, ring = places(), ring_of()
    yield (
        '<defs><marker id="tip" viewBox="0 0 8 8" refX="7" refY="4" markerWidth="6" '
        'markerHeight="6" orient="auto"><path d="M0 0L8 4L0 8z" fill="#64748b"/></marker></defs>'
    )
    for (start, end), count in sorted(arrows().items()):
        if ring[start] - ring[end] != 1:
            continue
        (x1, y1, w1), (x2, y2, w2) = at[start], at[end]
        yield (
            f'<line x1="{x1 + w1 / 2:.0f}" y1="{y1 + BOX:.0f}" x2="{x2 + w2 / 2:.0f}" '
            f'y2="{y2:.0f}" stroke="#64748b" stroke-width="{min(3, 0.6 + count / 10):.1f}" '
            'opacity="0.55" marker-end="url(#tip)"/>'
        )


def _boxes() -> Iterator[str]:
    for room, (x, y, width) in places().items():
        yield (
            f'<rect x="{x:.0f}" y="{y:.0f}" width="{width:.0f}" height="{BOX}" rx="5" '
            'fill="#fff" stroke="#334155"/>'
        )
        yield _text(x + 8, y + 18, label(room), 13, 'font-weight="bold"')
        lines = textwrap.wrap(
            purpose(room), max(10, int(width / 5.7)), max_lines=3, placeholder=" …"
        )
        for row, line in enumerate(lines, 1):
            yield _text(x + 8, y + 18 + 13 * row, line, 10)
        numbers = [str(i) for i, s in enumerate(STEPS, 1) if room_of(PACKAGE / s.module) == room]
        for i, number in enumerate(reversed(numbers)):
            yield _number(x + width - 12 - 20 * i, y, number)


def _number(x: float, y: float, number: str) -> str:
    middle = _text(x, y + 4, number, 11, 'text-anchor="middle" style="fill:#fff"')
    return f'<circle cx="{x:.0f}" cy="{y:.0f}" r="9" fill="#b91c1c"/>{middle}'


def _legend(height: int) -> Iterator[str]:
    top = height - 22 * ((len(STEPS) + 1) // 2) - 14
    yield _text(MARGIN, top - 8, "The path of a training step", 13, 'font-weight="bold"')
    half = (len(STEPS) + 1) // 2
    for i, step in enumerate(STEPS):
        x, y = MARGIN + 10 + (i // half) * (WIDTH // 2), top + 14 + 22 * (i % half)
        yield _number(x, y, str(i + 1))
        yield _text(x + 16, y + 4, f"{step.module}: {step.does}", 11)


def rooms_table() -> str:
    """Return a Markdown table of every room: ring, purpose, modules."""
    rows = ["| room | ring | what it is for | modules |", "| --- | --- | --- | --- |"]
    for index, ring in reversed(list(enumerate(RINGS))):
        for room in ring.rooms:
            folder = PACKAGE / room
            files = sorted(folder.glob("*.py")) if folder.is_dir() else []
            names = " ".join(f"`{f.stem}`" for f in files if f.stem != "__init__")
            rows.append(f"| `{label(room)}` | {index} | {purpose(room)} | {names} |")
    return "\n".join(rows)


def steps_list() -> str:
    """Return a Markdown list of the functions of a step, each linked to its file."""
    return "\n".join(
        f"{i}. [`{s.module}`](../{NAME}/{s.module}) `{s.function}`: {s.does}."
        for i, s in enumerate(STEPS, 1)
    )


def page() -> str:
    """Return the architecture page with its generated sections made from the current code."""
    text = PAGE.read_text()
    for name, made in (("rooms", rooms_table()), ("steps", steps_list())):
        section = re.compile(rf"(<!-- {name} -->\n).*?(\n<!-- end -->)", re.DOTALL)
        text = section.sub(lambda match, made=made: f"{match[1]}{made}{match[2]}", text)
    return text


if __name__ == "__main__":
    PICTURE.write_text(svg())
    PAGE.write_text(page())
    print(PICTURE.relative_to(ROOT), PAGE.relative_to(ROOT))
