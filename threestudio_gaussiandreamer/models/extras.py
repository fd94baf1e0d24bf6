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
            raise missing_extra(extra, module, str(error)) from error


def missing_extra(extra: str, module: str, problem: str) -> UserError:
    """Make the error for a missing module, with the command that installs ``extra``."""
    return UserError(
        f"this part needs {module} ({problem}): pip install 'threestudio-gaussiandreamer[{extra}]'"
    )
