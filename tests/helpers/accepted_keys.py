"""The keys that our parts accept, and the names that our code reads."""

import ast
import dataclasses
from pathlib import Path

from threestudio_gaussiandreamer import host

PACKAGE = Path(__file__).parents[2] / "threestudio_gaussiandreamer"


def config_classes():
    """Return the Config of everything registered by this package by name, nested dataclasses
    included.
    """
    found = {}
    for name in host.names():
        part = host.find(name)
        config = getattr(part, "Config", None)
        if part.__module__.startswith(PACKAGE.name) and dataclasses.is_dataclass(config):
            found[name] = config
            nested = (f for f in dataclasses.fields(config) if dataclasses.is_dataclass(f.type))
            found |= {f"{name}.{field.name}": field.type for field in nested}
    return found


def names_that_are_read():
    """Return attributes, words of strings, and parameters in the package's code, except in
    docstrings.
    """
    read = {f"prompt_{direction}" for direction in ("front", "side", "back", "overhead")}  # getattr
    for path in PACKAGE.rglob("*.py"):
        tree = ast.parse(path.read_text())
        docstrings = {id(node.value) for node in ast.walk(tree) if isinstance(node, ast.Expr)}
        for node in ast.walk(tree):
            if isinstance(node, ast.Attribute) and isinstance(node.ctx, ast.Load):
                read.add(node.attr)
            elif isinstance(node, ast.arg):
                read.add(node.arg)
            elif isinstance(getattr(node, "value", None), str) and id(node) not in docstrings:
                read |= set(node.value.replace(".", " ").split())
    return read
