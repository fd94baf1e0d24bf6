"""The files that are installed; the editable installation that tests run in hides missing ones."""

import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[1]
PACKAGE = "threestudio_gaussiandreamer"
NOT_INSTALLED = {".md", ".pyc", ".so", ".clang-format"}
"""Documents, and what is compiled."""


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
    installed = files_in(tmp_path / "built" / PACKAGE)
    configs = {f"configs/{name}" for name in files_in(ROOT / "configs")}
    assert installed == files_in(ROOT / PACKAGE) | configs


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
