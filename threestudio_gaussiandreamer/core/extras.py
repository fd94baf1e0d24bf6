"""Optional dependencies."""

import re
from importlib import import_module, metadata
from typing import Optional

from .errors import UserError

MODULES = {
    "scikit-image": "skimage",
    "usd-core": "pxr",
    "transformers": "transformers tokenizers huggingface_hub",
}
"""Modules of a package, or what it brings, where they have other names than it."""
FOR_TESTS = ("test", "farm-test")


def extras() -> dict[str, list[str]]:
    """Return the modules of each extra, by the metadata of the package, if it is installed."""
    found: dict[str, list[str]] = {}
    try:
        requirements = metadata.requires("threestudio-gaussiandreamer") or []
    except metadata.PackageNotFoundError:
        return found
    for line in requirements:
        extra = re.search(r"extra == ['\"](.+?)['\"]", line)
        if extra and extra[1] not in FOR_TESTS:
            name = re.match(r"[\w.-]+", line)[0]
            modules = MODULES.get(name, name.replace("-", "_")).split()
            found.setdefault(extra[1], []).extend(modules)
    return found


def require_extra(extra: str, *modules: str) -> None:
    """Raise UserError, which says how to install ``extra``, unless ``modules`` can be imported."""
    for module in modules:
        try:
            import_module(module)
        except ImportError as error:
            raise missing_extra(extra, module, str(error)) from error


def missing_extra(extra: str, module: str, problem: str) -> UserError:
    """Make the error for a missing module, with the command that installs ``extra``."""
    install = f"pip install 'threestudio-gaussiandreamer[{extra}]'"
    return UserError(f"this part needs {module} ({problem}): {install}")


def error_of_extra(error: BaseException) -> Optional[UserError]:
    """Return the message for a module of an extra that isn't installed; None for other errors."""
    if not isinstance(error, ModuleNotFoundError):
        return None
    module = (error.name or "").partition(".")[0]
    extra = next((extra for extra, modules in extras().items() if module in modules), None)
    return extra and missing_extra(extra, module, str(error))
