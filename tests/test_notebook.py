"""The cells of the notebook run, in a folder with the files of a checkout."""

import json
import re
import subprocess
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).parent.parent
NOTEBOOK = json.loads((ROOT / "notebooks/gaussiandreamer.ipynb").read_text())
TINY = (
    "trainer.max_steps=2 data.eval_width=16 data.eval_height=16 data.n_test_views=2 "
    "system.evaluation.views=2 system.evaluation.size=16"
)


def source(cell: dict[str, Any]) -> str:
    return "".join(cell["source"])


def code() -> dict[str, str]:
    return {cell["id"]: source(cell) for cell in NOTEBOOK["cells"] if cell["cell_type"] == "code"}


def as_python(cell: str) -> str:
    """Return the source of a cell with IPython's ``!command {name}`` as calls of ``shell``."""
    return re.sub(r"^(\s*)!(.*)$", r'\1shell(rf"""\2 """)', cell, flags=re.MULTILINE)


def test_it_is_stored_without_outputs_and_its_links_lead_somewhere():
    ids = [cell["id"] for cell in NOTEBOOK["cells"]]
    assert len(set(ids)) == len(ids) and NOTEBOOK["nbformat"] == 4
    for cell in NOTEBOOK["cells"]:
        assert cell.get("outputs", []) == [] and cell.get("execution_count") is None
        for target in re.findall(r"\]\(([^)]+)\)", source(cell)):
            assert (ROOT / "notebooks" / target).is_file(), target


def test_the_address_is_asked_for_outside_a_checkout(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(AssertionError, match="set REPOSITORY"):
        exec(as_python(code()["install"]), {})


@pytest.mark.slow
def test_its_cells_run(tmp_path, monkeypatch):
    for name in ("launch.py", "configs", "custom", "threestudio_gaussiandreamer"):
        (tmp_path / name).symlink_to(ROOT / name)
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(ROOT))
    commands: list[str] = []

    def shell(command: str) -> None:
        commands.append(command)
        if "pip install" not in command:
            subprocess.run(command, shell=True, check=True)

    cells, names = code(), {"shell": shell}
    exec(as_python(cells["install"]), names)
    exec(as_python(cells["prompt"].replace('OPTIONS = ""', f'OPTIONS = "{TINY}"')), names)
    exec(as_python(cells["mesh"]).replace("\nshow(", "\nshown = ("), names)
    assert len(commands) == 3 and 'pip install -q -e ".[diffusion]"' in commands[0]
    for cell in ("show", "mesh"):
        setup, expression = cells[cell].rstrip().rsplit("\n", 1)
        exec(setup if cell == "show" else "", names)
        assert "<iframe srcdoc=" in eval(expression, names)._repr_html_()
    files = eval(cells["files"], names)
    assert {Path(file).suffix for file in files} >= {".ply", ".spz", ".html"}
    assert all(f"outputs/{name}/notebook" in str(files) for name in ("toybox", "demo"))
