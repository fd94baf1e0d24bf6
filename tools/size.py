"""Print the size of the house against its bounds: ``python -m tools.size``.

``tools/sizes.json`` has for each line the bound to reach and the ceiling, a figure of the past.
The exit code is 1 if a figure is above its ceiling. ``--lower`` lowers ceilings to today's figures;
none rises. ``--frames`` also trains a step, see ``tools/frames.py``.
"""

import argparse
import ast
import functools
import json
import re
import sys
from collections.abc import Iterator
from pathlib import Path

from tests import architecture as plan
from tests.architecture import PACKAGE, ROOT, sources

from .frames import calls_in_a_step

SIZES = Path(__file__).with_name("sizes.json")
TOGETHER = {"prune": "prune, convert", "convert": "prune, convert"}
GENERATED = re.compile(r"<!-- (?!end)[^>]*-->.*?<!-- end -->", re.DOTALL)
OURS = re.compile(r"(self|cls|mcs|super\(\))$")
PRIVATE = re.compile(r"_(?!_|(asdict|fields|make|replace|name_|value_)$)")


def lines(*paths: Path) -> int:
    return sum(len(path.read_text(encoding="utf-8").splitlines()) for path in paths)


def words(page: Path) -> int:
    """Count the words of a page outside the sections that ``make docs`` writes."""
    return len(GENERATED.sub("", page.read_text(encoding="utf-8")).split())


@functools.cache
def nodes(path: Path) -> list[ast.AST]:
    return list(ast.walk(ast.parse(path.read_text(encoding="utf-8"))))


def all_nodes(folder: Path) -> Iterator[ast.AST]:
    return (node for path in sorted(folder.rglob("*.py")) for node in nodes(path))


def others_private(folder: Path) -> int:
    """Count accesses to another object's private names, as ruff's SLF001."""
    found = (n for n in all_nodes(folder) if isinstance(n, ast.Attribute))
    found = (n for n in found if PRIVATE.match(n.attr))
    return sum(not OURS.match(ast.unparse(n.value)) for n in found)


def circles() -> int:
    """Count the groups of modules that import each other at module level, also for their types."""
    reached: dict[str, set[str]] = {}
    for path in sources():
        found, todo = set(), list(nodes(path)[0].body)
        while todo:
            node = todo.pop()
            found |= set(plan.imported(node, path))
            todo += getattr(node, "body", []) if not isinstance(node, ast.FunctionDef) else []
        name = ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")
        reached[name] = found - {name}
    for middle in reached:  # Warshall's transitive closure
        for ends in reached.values():
            ends |= reached[middle] if middle in ends else set()
    within = [
        frozenset(b for b in reached if b in ends and a in reached[b])
        for a, ends in reached.items()
        if a in ends
    ]
    return len(set(within))


def options() -> int:
    """Count the fields of the dataclasses of options, each in the class that declares it."""
    of = [n for n in all_nodes(PACKAGE) if isinstance(n, ast.ClassDef)]
    of = [n for n in of if n.decorator_list and n.name.endswith(("Config", "Options"))]
    found = [f.target for n in of for f in n.body if isinstance(f, ast.AnnAssign)]
    return sum(not target.id.isupper() for target in found)  # but constants


def figures() -> dict[str, int]:
    """Return the figure of every line of the table but the frames."""
    python, rings = [PACKAGE / "__init__.py", *sources()], plan.ring_of()
    found = {"package": lines(*python)}
    for path in python:
        room = plan.room_of(path) if path.parent != PACKAGE else "cameras, metrics, top"
        found[TOGETHER.get(room, room)] = found.get(TOGETHER.get(room, room), 0) + lines(path)
    found |= {name: lines(*(ROOT / name).rglob("*.py")) for name in ("tests", "benchmarks")}
    pages = {f"docs/{page.name}": words(page) for page in sorted((ROOT / "docs").glob("*.md"))}
    found |= {"words of docs": sum(pages.values()), "words of README": words(ROOT / "README.md")}
    found |= {"files of the package": len(python), "import circles": circles()}
    found["arrows upwards"] = sum(rings[to] > rings[room] for room, to in plan.arrows())
    raised = [n.exc for n in all_nodes(PACKAGE) if isinstance(n, ast.Raise) and n.exc]
    found["raise UserError"] = sum(ast.unparse(exc).startswith("UserError") for exc in raised)
    found |= {"options": options(), "private names of others": others_private(PACKAGE)}
    return found | {"the same in promises": others_private(ROOT / "tests/promises")} | pages


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--lower", action="store_true", help="lower the ceilings to today's")
    parser.add_argument("--frames", action="store_true", help="train a step; half a minute")
    args = parser.parse_args()
    sizes = json.loads(SIZES.read_text(encoding="utf-8"))
    found = (calls_in_a_step() if args.frames else {}) | figures()
    print(f"{'':32}{'today':>8}{'ceiling':>9}{'bound':>8}")
    for name, figure in found.items():
        bound, ceiling = sizes.get(name, ("", ""))
        above = "  above its ceiling" if name in sizes and figure > ceiling else ""
        print(f"{name:32}{figure:>8}{ceiling:>9}{bound:>8}{above}")
    if args.lower:
        sizes |= {n: [b, min(c, found.get(n, c))] for n, (b, c) in sizes.items()}
        rows = [f"  {json.dumps(name)}: {json.dumps(pair)}" for name, pair in sizes.items()]
        SIZES.write_text("{\n" + ",\n".join(rows) + "\n}\n", encoding="utf-8")
    return int(any(found.get(name, 0) > ceiling for name, (_, ceiling) in sizes.items()))


if __name__ == "__main__":
    sys.exit(main())
