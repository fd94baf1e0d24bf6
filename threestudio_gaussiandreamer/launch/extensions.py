"""Extensions of the user: every module in ``./custom`` is imported, so that its ``@register``
decorators run.

As in threestudio, a folder with an ``__init__.py`` is imported under its own name, which may have
hyphens, and may use relative imports; a file ``part.py`` is imported as ``custom/part``. Names that
end in ``_disabled`` or begin with a dot are skipped."""

import importlib.machinery
import importlib.util
import sys
import traceback
from pathlib import Path

from ..core.errors import Terminated, UserError
from ..host import info


def load_extensions(folder: Path = Path("custom")) -> list[str]:
    """Import all extensions in ``folder``, sorted by name, and return their module names.

    Raises:
        UserError: the folder can't be read, or an extension fails to import; the message names the
            file, the line and the cause.
    """
    try:
        entries = sorted(folder.iterdir()) if folder.is_dir() else []
        extensions = [entry for entry in entries if _is_extension(entry)]
    except OSError as error:
        raise UserError(f"the extensions in {folder} can't be read: {error}") from error
    return [_load(entry) for entry in extensions]


def _is_extension(entry: Path) -> bool:
    if entry.name.startswith((".", "__")) or entry.stem.endswith("_disabled"):
        return False
    if entry.is_dir() and not (entry / "__init__.py").is_file():
        info(f"{entry} has no __init__.py: not an extension")
        return False
    if entry.suffix == ".py" and not entry.is_dir() and not entry.is_file():
        info(f"{entry} is no readable file (a FIFO, or a link to nothing): not an extension")
        return False
    return entry.is_dir() or entry.suffix == ".py"


def _load(entry: Path) -> str:
    name, file = (
        (entry.name, entry / "__init__.py") if entry.is_dir() else (f"custom/{entry.stem}", entry)
    )
    loaded = sys.modules.get(name)
    if loaded is not None and Path(loaded.__file__ or "").resolve() == file.resolve():
        return name
    if entry.is_dir() and _is_installed(name):
        raise UserError(f"the extension {entry} has the name of a module: rename the folder")
    spec = importlib.util.spec_from_file_location(name, file.resolve())
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    try:
        spec.loader.exec_module(module)
    except (Exception, SystemExit) as error:
        del sys.modules[name]
        if isinstance(error, Terminated):
            raise
        raise UserError(
            f"the extension {entry} can't be imported: {_cause(error, entry)}"
        ) from error
    return name


def _is_installed(name: str) -> bool:
    """Return whether ``import name`` finds a module or package, which has a file."""
    found = importlib.machinery.PathFinder.find_spec(name)
    return name in sys.stdlib_module_names or (found is not None and found.origin is not None)


def _cause(error: BaseException, entry: Path) -> str:
    """Describe an error as ``file:line: message``, with the innermost line in the extension."""
    what = f"{type(error).__name__}: {error}"
    if isinstance(error, SyntaxError) and error.lineno:
        return f"{error.filename}:{error.lineno}: {error.msg}"
    root = str(entry.resolve())
    inside = [
        frame
        for frame in traceback.extract_tb(error.__traceback__)
        if frame.filename.startswith(root)
    ]
    return f"{inside[-1].filename}:{inside[-1].lineno}: {what}" if inside else what
