"""Optional dependencies: the check that they are installed."""

from importlib import import_module
from typing import Optional

from .errors import UserError

EXTRAS = {
    "diffusion": "accelerate diffusers huggingface_hub safetensors sentencepiece tokenizers "
    "transformers",
    "mesh": "fast_simplification skimage xatlas",
    "smpl": "smplx",
    "viewer": "viser",
    "cluster": "pyarrow ray s3fs",
    "formats": "zstandard",
    "charts": "matplotlib",
}
"""Modules of each extra."""


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


def error_of_extra(error: BaseException) -> Optional[UserError]:
    """Return the message for a module of an extra that isn't installed; None for other errors."""
    if not isinstance(error, ModuleNotFoundError):
        return None
    module = (error.name or "").partition(".")[0]
    found = (extra for extra, modules in EXTRAS.items() if module in modules.split())
    extra = next(found, None)
    return extra and missing_extra(extra, module, str(error))
