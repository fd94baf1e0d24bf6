"""Imports point inwards, the package is cheap to import, no code stands twice; sizes, the wheel."""

import ast
import re
import subprocess
import sys
from collections.abc import Iterable
from pathlib import Path

import pytest

from tests import architecture
from tests.architecture import NAME, PACKAGE, PAGE, ROOT, STEPS, room_of, sources
from tools import size

RINGS = architecture.ring_of()
MATHS_MAY_USE = {"torch", "numpy", "scipy", "jaxtyping"} | set(sys.stdlib_module_names)
LIBRARIES = {  # of ring 0, beyond MATHS_MAY_USE
    "images": {"PIL"},
    "formats": {"PIL", "pxr", "tqdm", "zstandard"},
    "meshes": {"trimesh", "embreex", "PIL", "tqdm"},
}
HOST = {"lightning", "pytorch_lightning", "omegaconf", "threestudio"}
HEAVY = {"fast_simplification", "xatlas", *HOST}
HEAVY |= {*"trimesh embreex diffusers transformers PIL anny pxr zstandard skimage".split()}
MODULES_AT_THE_TOP = 5
MOST_EQUAL_LINES = 5
PUNCTUATION = "()[]{}<>*,;:'\" "
KERNEL_SOURCES = {".cpp", ".cu", ".cuh", ".h"}
IMPORTS = re.compile(r"^from \S+ import \([^)]*\)", re.MULTILINE)
TOPS = (NAME, "tests", "benchmarks", "tools")
CODE = [path for top in TOPS for path in sorted((ROOT / top).rglob("*.py"))]


def named(path: Path) -> str:
    return str(path.relative_to(ROOT))


def test_every_room_has_a_ring_and_a_purpose_and_few_modules_lie_beside_them():
    assert {room_of(path) for path in sources()} == set(RINGS)
    assert all(architecture.purpose(room) for room in RINGS)
    assert len(list(PACKAGE.glob("*.py"))) <= MODULES_AT_THE_TOP


def test_imports_point_inwards_and_libraries_are_imported_where_they_belong():
    """Heavy libraries are imported where they are used; one file imports threestudio."""
    wrong = []
    for path in sources():
        room, ring = room_of(path), RINGS[room_of(path)]
        maths = MATHS_MAY_USE | LIBRARIES.get(room, set())
        for name, top_level in architecture.imports(path):
            library, *rest = name.split(".")
            if library == NAME:
                allowed = not rest or RINGS[rest[0]] <= ring
            elif library == "threestudio":
                allowed = path == PACKAGE / "host/__init__.py"
            else:
                eager = top_level and library in HEAVY - (HOST if ring else set())
                allowed = not eager and (ring > 0 or library in maths)
            wrong += [] if allowed else [f"{named(path)} imports {name}"]
    assert not wrong, wrong


def test_importing_the_package_is_cheap():
    code = (
        f"import sys, {NAME}; print([m for m in sys.modules if m.split('.')[0] in "
        f"{sorted(HEAVY | {'torch', 'numpy'})}])"
    )
    command = [sys.executable, "-c", code]
    found = subprocess.run(command, capture_output=True, text=True, check=True, cwd=ROOT)
    assert found.stdout.strip() == "[]"


def test_ruff_finds_nothing():
    """Short lines, no unused names, text in UTF-8 and not in the locale's encoding."""
    pytest.importorskip("ruff")
    command = [sys.executable, "-m", "ruff", "check", "--no-cache", "--output-format=concise"]
    found = subprocess.run(command, capture_output=True, text=True, cwd=ROOT)
    assert found.returncode == 0, found.stdout


def code_lines(path: Path) -> list[tuple[int, str]]:
    """Return number and text of the lines of code, without imports and punctuation alone."""
    text = re.sub(IMPORTS, lambda found: "\n" * found[0].count("\n"), path.read_text())
    lines = [" ".join(line.split()) for line in text.splitlines()]
    return [
        (number, line)
        for number, line in enumerate(lines, 1)
        if line.strip(PUNCTUATION) and not line.startswith(("#", "//", "import ", "from "))
    ]


def duplicates(paths: Iterable[Path]) -> list[str]:
    """Return the places of ``MOST_EQUAL_LINES`` + 1 lines of code that stand somewhere before."""
    seen: dict[tuple[str, ...], str] = {}
    found = []
    for path in paths:
        lines = code_lines(path)
        for start in range(len(lines) - MOST_EQUAL_LINES):
            window = lines[start : start + MOST_EQUAL_LINES + 1]
            place = f"{named(path)}:{window[0][0]}"
            first = seen.setdefault(tuple(line for _, line in window), place)
            found += [f"{place} repeats {first}"] if first != place else []
    return found


def test_no_lines_of_code_stand_twice():
    """A pair of the same letter: give the code one place, if its logic is the same."""
    kernels = [path for path in PACKAGE.rglob("*") if path.suffix in KERNEL_SOURCES]
    assert not duplicates([*CODE, *sorted(kernels)])


@pytest.mark.parametrize("step", STEPS, ids=lambda step: step.module)
def test_every_function_of_the_step_exists(step):
    tree = ast.parse((PACKAGE / step.module).read_text())
    assert step.function in {getattr(node, "name", None) for node in ast.walk(tree)}


def test_the_architecture_page_is_of_this_code():
    again = "it is stale: run python -m tests.architecture"
    assert PAGE.read_text() == architecture.page(), again


@pytest.mark.parametrize("more", [[], pytest.param(["--frames"], marks=pytest.mark.slow)], ids=str)
def test_no_figure_is_above_its_ceiling(more):
    command = [sys.executable, "-m", "tools.size", *more]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout[-5000:] + done.stderr[-2000:]
    assert not more or "frames to the U-Net" in done.stdout


def test_circles_and_private_names_are_found(tmp_path, monkeypatch):
    package = tmp_path / "package"
    package.mkdir()
    (package / "a.py").write_text("from . import b\nself._x = other._y._z\n")
    (package / "b.py").write_text("if TYPE_CHECKING:\n    from .a import A\n")
    (package / "c.py").write_text("from .a import A\n\n\ndef f():\n    from .d import D\n")
    (package / "d.py").write_text("from .c import C\n")
    for name, value in {"ROOT": tmp_path, "PACKAGE": package, "NAME": "package"}.items():
        monkeypatch.setattr(architecture, name, value)
        monkeypatch.setattr(size, name, value, raising=False)
    architecture.modules.cache_clear()
    try:
        assert size.circles() == 1 and size.others_private(package) == 2
    finally:
        architecture.modules.cache_clear()


NOT_INSTALLED = {".md", ".pyc", ".so", ".clang-format"}
"""Documents, and what is compiled. The tests' editable installation hides missing files."""


def files_in(folder: Path) -> set[str]:
    return {
        str(path.relative_to(folder))
        for path in folder.rglob("*")
        if path.is_file() and not {path.suffix, path.name} & NOT_INSTALLED
    }


def test_every_file_of_the_package_and_every_config_is_installed(tmp_path):
    command = [sys.executable, "setup.py", "-q", "egg_info", "-e", str(tmp_path)]
    command += ["build_py", "-d", str(tmp_path / "built")]
    subprocess.run(command, cwd=ROOT, check=True, capture_output=True)
    installed = files_in(tmp_path / "built" / NAME)
    configs = {f"configs/{name}" for name in files_in(ROOT / "configs")}
    assert installed == files_in(PACKAGE) | configs


def test_a_wheel_is_for_every_python_3_of_one_platform():
    """The libraries are called through ctypes and know nothing of Python."""
    code = (
        "import sys; sys.argv = ['setup.py', '-q', '--version']; import runpy; "
        "setup = runpy.run_path('setup.py'); from setuptools.dist import Distribution; "
        "wheel = setup['PlatformWheel'](Distribution({'name': 'x'})); "
        "wheel.ensure_finalized(); print(*wheel.get_tag()[:2])"
    )
    command = [sys.executable, "-c", code]
    said = subprocess.run(command, cwd=ROOT, check=True, capture_output=True, text=True)
    assert said.stdout.splitlines()[-1] == "py3 none"
