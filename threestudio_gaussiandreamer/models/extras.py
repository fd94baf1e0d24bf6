"""Optional dependencies: the check that they are installed."""

from importlib import import_module

from ..core.errors import UserError


def require_extra(extra: str, *modules: str) -> None:
    """Raise UserError, with the command that installs ``extra``, unless all of its ``modules`` can
    be imported.
    """
    for module in modules:
        try:
            import_module(module)
        except ImportError as error:
            raise UserError(
                f"this part needs {module} ({error}): pip install "
                f"'threestudio-gaussiandreamer[{extra}]'"
            ) from error
