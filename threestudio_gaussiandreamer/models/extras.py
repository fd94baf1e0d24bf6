"""Optional dependencies: what to install when a part needs one that isn't there."""

from importlib import import_module

from ..core.errors import UserError


def require_extra(extra: str, *modules: str) -> None:
    """Raise UserError, which says what to install, unless all ``modules`` of the package's
    ``extra`` can be imported.
    """
    for module in modules:
        try:
            import_module(module)
        except ImportError as error:
            raise UserError(
                f"this part needs {module} ({error}): pip install "
                f"'threestudio-gaussiandreamer[{extra}]'"
            ) from error
