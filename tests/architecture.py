"""Draw the package's rooms, rings and the path of a step: ``python -m tests.architecture``.

Writes the parts between the markers of ``docs/architecture.md``, which test_structure.py checks.
"""

import ast
import functools
import re
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).resolve().parents[1]
NAME = "threestudio_gaussiandreamer"
PACKAGE = ROOT / NAME
PAGE = ROOT / "docs/architecture.md"


FILES = ("cameras", "images", "metrics")
MATHS = ("core", "gaussians", "formats", "splatting", "diffusion", "meshes", *FILES)
RINGS = {
    "0 maths": MATHS,
    "1 host": ("host", "models"),
    "2 parts": ("prompts", "priors", "guidance", "surface", "exporters"),
    "3 training": ("training", "prune", "view", "convert"),
    "4 programs": ("launch", "farm", "evaluation", "evaluate", "toybox", "studio"),
}
"""Layers of the package; the rooms of one import from it and from those before it."""


class Step(NamedTuple):
    """A function on the path from the command line to a training step."""

    module: str
    function: str
    does: str


STEPS = (
    Step("launch/experiment.py", "main", "parse arguments, load and check the configuration"),
    Step("launch/run.py", "Run", "build data module, system, trainer; fit, test, export"),
    Step("training/data.py", "GaussianDreamerDataModule", "draw the cameras of step k"),
    Step("training/system.py", "training_step", "render, score, sum the losses, backward"),
    Step("training/renderer.py", "forward", "convert host cameras to OpenCV, composite"),
    Step("splatting/backends.py", "rasterize", "validate, choose a backend, splat"),
    Step("guidance/base.py", "ScoreDistillation", "encode; variant: noise, predict; weigh, clip"),
    Step("diffusion/sds.py", "diffuse", "add noise to the latents"),
    Step("training/density.py", "DensityControl", "clone, split and drop Gaussians after the step"),
    Step("core/checkpoint_file.py", "save_file", "write a checkpoint atomically"),
)


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
    return {room: index for index, rooms in enumerate(RINGS.values()) for room in rooms}


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
    ours = [(room_of(p), name) for p in sources() for name, _ in imports(p) if f"{NAME}." in name]
    pairs = ((room, name.split(".")[1]) for room, name in ours)
    return Counter(pair for pair in pairs if pair[0] != pair[1])


def purpose(room: str) -> str:
    """Return the first sentence of a room's docstring."""
    folder = PACKAGE / room
    text = (folder / "__init__.py" if folder.is_dir() else folder.with_suffix(".py")).read_text()
    words = " ".join((ast.get_docstring(ast.parse(text)) or "").split("\n\n")[0].split())
    return re.split(r"(?<=\.) ", words)[0].rstrip(".").replace("``", "")


def label(room: str) -> str:
    return f"{room}/" if (PACKAGE / room).is_dir() else f"{room}.py"


def diagram() -> str:
    """Return a Mermaid diagram: rings with their rooms, and imports from one to the next lower."""
    lines, ring = ["```mermaid", "flowchart TB"], ring_of()
    for index, (name, rooms) in reversed(list(enumerate(RINGS.items()))):
        lines.append(f'  subgraph ring{index}["{name}"]')
        for room in rooms:
            path = enumerate(STEPS, 1)
            numbers = [str(i) for i, s in path if room_of(PACKAGE / s.module) == room]
            steps = f" ({', '.join(numbers)})" if numbers else ""
            lines.append(f'    {room}["{label(room)}{steps}"]')
        lines.append("  end")
    pairs = sorted(pair for pair in arrows() if ring[pair[0]] - ring[pair[1]] == 1)
    lines += [f"  {start} --> {end}" for start, end in pairs]
    return "\n".join([*lines, "```"])


def rooms_table() -> str:
    """Return a Markdown table of every room: ring, purpose, modules."""
    rows = ["| room | ring | what it is for | modules |", "| --- | --- | --- | --- |"]
    for index, rooms in reversed(list(enumerate(RINGS.values()))):
        for room in rooms:
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
    parts = {"diagram": diagram(), "rooms": rooms_table(), "steps": steps_list()}
    for name, made in parts.items():
        section = re.compile(rf"(<!-- {name} -->\n).*?(\n<!-- end -->)", re.DOTALL)
        text = section.sub(lambda match, made=made: f"{match[1]}{made}{match[2]}", text)
    return text


if __name__ == "__main__":
    PAGE.write_text(page())
    print(PAGE.relative_to(ROOT))
