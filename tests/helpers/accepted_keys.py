"""The keys that our parts accept, and the names that our code reads."""

import ast
import dataclasses
from pathlib import Path

from threestudio_gaussiandreamer import host

PACKAGE = Path(__file__).parents[2] / "threestudio_gaussiandreamer"


def config_classes():
    """Return (part, Config) of everything registered by this package, nested dataclasses
    included.
    """
    found = {}
    for name in host.names():
        part = host.find(name)
        if part.__module__.startswith(PACKAGE.name) and dataclasses.is_dataclass(
            getattr(part, "Config", None)
        ):
            found[f"{name}"] = part.Config
            for field in dataclasses.fields(part.Config):
                if dataclasses.is_dataclass(field.type):
                    found[f"{name}.{field.name}"] = field.type
    return found


def names_that_are_read():
    """Return attributes, strings, keywords and parameters in the package's code, except in
    dataclass bodies.
    """
    read = set()
    for path in PACKAGE.rglob("*.py"):
        tree = ast.parse(path.read_text())
        docstrings = {id(node.value) for node in ast.walk(tree) if isinstance(node, ast.Expr)}
        for node in ast.walk(tree):
            if isinstance(node, ast.Attribute) and isinstance(node.ctx, ast.Load):
                read.add(node.attr)
            elif (
                isinstance(node, ast.Constant)
                and isinstance(node.value, str)
                and id(node) not in docstrings
            ):
                read |= set(node.value.replace(".", " ").split())
            elif isinstance(node, ast.arg):
                read.add(node.arg)
    return read
