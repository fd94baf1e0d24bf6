"""Imports point inwards only, the package is cheap to import, and only one file knows the host."""

import ast
import subprocess
import sys
from pathlib import Path

PACKAGE = Path(__file__).parent.parent / "threestudio_gaussiandreamer"
NAME = PACKAGE.name
RINGS = {  # folder, or module beside __init__ -> ring; imports point to the same or a lower ring
    "core": 0,
    "gaussians": 0,
    "formats": 0,
    "splatting": 0,
    "diffusion": 0,
    "meshes": 0,
    "cameras": 0,
    "metrics": 0,
    "host": 1,
    "models": 1,
    "prompts": 2,
    "priors": 2,
    "guidance": 2,
    "exporters": 2,
    "training": 3,
    "prune": 3,
    "launch": 4,
    "evaluation": 4,
}
LIBRARIES = {
    "core": {"imageio", "PIL"},
    "meshes": {"trimesh", "embreex", "PIL", "tqdm"},
}  # of ring 0, beyond MATHS_MAY_USE
HEAVY = {
    "lightning",
    "pytorch_lightning",
    "omegaconf",
    "trimesh",
    "embreex",
    "diffusers",
    "transformers",
    "threestudio",
    "imageio",
    "PIL",
    "smplx",
}
MATHS_MAY_USE = {"torch", "numpy", "scipy", "jaxtyping"} | set(sys.stdlib_module_names)


def modules():
    return [
        path
        for path in sorted(PACKAGE.rglob("*.py"))
        if path.name != "__init__.py" or path.parent != PACKAGE
    ]


def ring(top: str) -> int:
    """0 maths, 1 host, 2 parts, 3 training, 4 programs; KeyError for a folder or module without a
    ring.
    """
    return RINGS[top]


def imports(path: Path):
    """(absolute module, at module level?) of every import statement."""
    package = [NAME, *path.relative_to(PACKAGE).parent.parts]
    tree = ast.parse(path.read_text())
    top_level = {id(node) for node in tree.body}
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from ((alias.name, id(node) in top_level) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = ".".join(package[: len(package) - node.level + 1]) if node.level else ""
            module = ".".join(filter(None, (base, node.module)))
            # "from .. import x" names the module x, or a name of the package itself
            names = (
                [module]
                if module != NAME
                else [f"{base}.{alias.name}" for alias in node.names if alias.name in RINGS]
            )
            yield from ((name, id(node) in top_level) for name in names)


def top(path: Path) -> str:
    return path.relative_to(PACKAGE).with_suffix("").parts[0]


def test_imports_point_inwards():
    outwards = []
    for path in modules():
        for name, _ in imports(path):
            if name.startswith(NAME + ".") and ring(name.split(".")[1]) > ring(top(path)):
                outwards.append(f"{path.relative_to(PACKAGE)} imports {name}")
    assert not outwards, outwards


def test_the_maths_needs_torch_numpy_and_scipy_only():
    foreign = [
        f"{path.relative_to(PACKAGE)} imports {name}"
        for path in modules()
        if ring(top(path)) == 0
        for name, _ in imports(path)
        if name.split(".")[0] not in MATHS_MAY_USE | LIBRARIES.get(top(path), set()) | {NAME}
    ]
    assert not foreign, foreign


def test_only_one_file_imports_threestudio():
    assert [
        str(path.relative_to(PACKAGE))
        for path in modules()
        if any(name.split(".")[0] == "threestudio" for name, _ in imports(path))
    ] == ["host/__init__.py"]


def test_heavy_libraries_are_imported_where_they_are_used():
    allowed = {
        "lightning",
        "pytorch_lightning",
        "omegaconf",
        "threestudio",
    }  # what the host itself is made of
    eager = [
        f"{path.relative_to(PACKAGE)} imports {name}"
        for path in modules()
        for name, top_level in imports(path)
        if top_level and name.split(".")[0] in HEAVY - (allowed if ring(top(path)) else set())
    ]
    assert not eager, eager


def test_importing_the_package_is_cheap():
    code = (
        f"import sys, {NAME}; print([m for m in sys.modules if m.split('.')[0] in "
        f"{sorted(HEAVY | {'torch', 'numpy'})}])"
    )
    found = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=PACKAGE.parent
    )
    assert found.stdout.strip() == "[]"
