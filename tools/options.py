"""Write docs/options.md from the tables at the heads of parts: ``python -m tools.options``."""

import ast
import re
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PACKAGE, PAGE = ROOT / "threestudio_gaussiandreamer", ROOT / "docs/options.md"
PLACES = {
    "data": ["training/data.py"],
    "system": ["training/system.py"],
    "system.geometry": ["training/geometry.py"],
    "system.geometry.prior": ["priors/base.py", "priors/*.py"],
    "system.renderer": ["training/renderer.py"],
    "system.background": ["training/background.py"],
    "system.prompt_processor": ["prompts/prompts.py", "prompts/*.py"],
    "system.guidance": ["guidance/base.py", "guidance/*.py"],
    "system.guidance.variant": ["guidance/variants/*.py"],
    "system.exporter": ["exporters/files.py", "surface/textured.py"],
    "viewer": ["launch/live_viewer.py"],
}
"""The modules whose tables describe a section of a configuration."""


def defaults(tree: ast.Module) -> dict[str, str]:
    """Map each field of the module's classes to the source text of its default."""
    found: dict[str, str] = {}
    for node in ast.walk(tree):
        if isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name) and node.value:
            value = node.value
            if isinstance(value, ast.Call) and ast.unparse(value.func) == "field":
                given = [word.value for word in value.keywords if word.arg == "default"]
                value = given[0] if given else None
            if not isinstance(value, ast.Subscript):  # of a class that isn't a Config
                found.setdefault(node.target.id, ast.unparse(value) if value else "")
    return found


def described(docstring: str) -> list[tuple[str, str]]:
    """Return the rows (option, meaning) of a docstring's table, or none if it has no table."""
    table = re.search(r"^=+ +=+\noption .*\n=.*\n((?s:.*?))^=", docstring, re.MULTILINE)
    rows: list[tuple[str, str]] = []
    for line in filter(str.strip, table[1].splitlines() if table else ()):
        option, meaning = re.fullmatch(r"(\S+(?: \S+)*)?(?: {2,}(.*))?", line).groups("")
        goes_on = rows and (not option or rows[-1][0].endswith(","))
        last = rows.pop() if goes_on else ("", "")
        rows.append((f"{last[0]} {option}".strip(), f"{last[1]} {meaning}".strip()))
    return rows


def text() -> str:
    """Return the page."""
    lines = [
        "# Options",
        "",
        "<!-- options -->",
        "`key=value` arguments of a run, or YAML: [how](running.md#configurations-and-overrides).",
        "`make docs` writes this page from the heads of the modules. At the top level there are",
        "`name`, `tag`, `seed`, `exp_root_dir`, `use_timestamp` and `resume`; `trainer` has the",
        "arguments of Lightning's `Trainer`, `checkpoint` those of its `ModelCheckpoint`. `x_type`",
        "selects the part whose options are in `x`.",
    ]
    for section, patterns in PLACES.items():
        paths = [path for pattern in patterns for path in sorted(PACKAGE.glob(pattern))]
        lines += ["", f"## `{section}`"] if paths else []
        for path in dict.fromkeys(paths):
            tree = ast.parse(path.read_text(encoding="utf-8"))
            rows = described(ast.get_docstring(tree) or "")
            if rows:
                values, name = defaults(tree), path.relative_to(PACKAGE)
                lines += ["", f"[`{name}`](../threestudio_gaussiandreamer/{name})", ""]
                lines += ["| option | default | meaning |", "| --- | --- | --- |"]
                for option, meaning in rows:
                    known = [values[name] for name in option.split(", ") if values.get(name)]
                    default = f"`{', '.join(known)}`" if known else ""
                    cells = (option, default, meaning.replace("``", "`"))
                    lines.append(f"| {' | '.join(c.replace('|', chr(92) + '|') for c in cells)} |")
    return "\n".join([*lines, "<!-- end -->", ""])


if __name__ == "__main__":
    PAGE.write_text(text(), encoding="utf-8")
