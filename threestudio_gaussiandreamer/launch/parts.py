"""The registered parts: those of this package, and the user's own in ``./custom``, of which every
module is imported but those whose names end in ``_disabled``; a folder with an ``__init__.py``
under its own name, which may have hyphens, as in threestudio."""

import importlib.util
import sys
import traceback
from importlib.machinery import PathFinder
from pathlib import Path
from typing import Any, Optional

from torch import nn

from .. import host
from ..core.errors import Terminated, UserError
from ..exporters.files import require_export
from ..guidance.base import ScoreDistillation
from ..guidance.variants import Variant
from ..host import find, info, names, pl
from ..host.methods import require_method
from ..priors.base import Prior
from ..prompts.prompt_processors import TextEncoderPromptProcessor
from ..training.density import DensityRule
from ..training.losses import SUFFIX

MODULES = {
    "training": "data background renderer density geometry",
    "priors": "mesh point_cloud gaussians random shap_e point_e motion anny",
    "guidance": "exact_score mock stable_diffusion deep_floyd mvdream stable_diffusion_3",
    "prompts": "prompts prompt_processors",
    "exporters": "files",
}
"""The modules of each room that register parts, or import those which do; the system is last."""

for room, modules in (*MODULES.items(), ("training", "system")):
    for module in modules.split():
        importlib.import_module(f"..{room}.{module}", __package__)

KINDS: dict[str, type] = {
    "data": pl.LightningDataModule,
    "system": pl.LightningModule,
    "geometry": host.BaseGeometry,
    "material": host.BaseMaterial,
    "background": host.BaseBackground,
    "renderer": host.Rasterizer,
    "exporter": host.Exporter,
    "prior": Prior,
    "density": DensityRule,
    "guidance": ScoreDistillation,
    "variant": Variant,
    "prompt_processor": TextEncoderPromptProcessor,
}
"""The base class of each kind of part, by the name of its section. Parts of other packages may have
others: a part is refused only if it derives from the base class of a different kind."""
CALLS = {"guidance": "rgb", "background": "dirs"}
"""The first argument of a call, of the kinds that other packages write without our base class."""


def find_part(path: str, type_name: Any) -> type:
    """Return the part that the key ``path`` names; the message of an error names the key too."""
    if not isinstance(type_name, str) or not type_name:
        overlay = " (an overlay needs the configuration that it changes before it)"
        raise UserError(
            f"{path} is {type_name!r}; expected the name of a registered part"
            f"{overlay if path == 'data_type' else ''}"
        )
    try:
        return find(type_name)
    except UserError as error:
        hint = " (own parts are imported from the folder custom here, and there is none)"
        raise UserError(f"{path}: {error}{'' if Path('custom').is_dir() else hint}") from error


def check_kind(path: str, type_name: str, part: Any) -> None:
    """Raise UserError if the part of a section is no class, of another kind or not callable."""
    if not isinstance(part, type):
        raise UserError(f"{path}: {type_name} is a {type(part).__name__}; register a class")
    kind, found = path.rpartition(".")[2].removesuffix("_type"), _kind_of(part)
    if found not in (None, kind) and kind in KINDS:
        choices = [name for name in names() if _kind_of(find(name)) == kind]
        raise UserError(
            f"{path} is {type_name!r}, a part of the kind {found}; expected one of the kind "
            f"{kind}: choose from {', '.join(choices)}"
        )
    try:
        if kind in CALLS:
            call = "forward" if issubclass(part, nn.Module) else "__call__"
            require_method(part, call, CALLS[kind], more=True)
        elif kind == "exporter":
            require_export(part)
    except UserError as error:
        raise UserError(f"{path}: {error}") from error


def parts_by_kind() -> dict[str, list[str]]:
    """Return the names of the registered parts; "other" has those without one of our bases."""
    found: dict[str, list[str]] = {}
    for name in names():
        is_loss = name.endswith(SUFFIX)
        kind = "regulariser" if is_loss else _kind_of(find(name)) or "other"
        found.setdefault(kind, []).append(name)
    return {kind: found[kind] for kind in (*KINDS, "regulariser", "other") if kind in found}


def _kind_of(part: Any) -> Optional[str]:
    # of threestudio's parts, the base class of threestudio
    bases = {kind: vars(base).get("HOST", base) for kind, base in KINDS.items()}
    is_class = isinstance(part, type)
    return next((kind for kind in bases if is_class and issubclass(part, bases[kind])), None)


# -- the user's own --------------------------------------------------------------------------------


def load_extensions(folder: Path = Path("custom")) -> list[str]:
    """Import all extensions in ``folder``, sorted by name, and return their module names."""
    try:
        entries = sorted(folder.iterdir()) if folder.is_dir() else []
        files = {entry: _file_of(entry) for entry in entries}
    except OSError as error:
        raise UserError(f"the extensions in {folder} can't be read: {error}") from error
    return [_load(entry, file) for entry, file in files.items() if file is not None]


def _file_of(entry: Path) -> Optional[Path]:
    """Return the file that an extension is imported from; None if it is none."""
    file = entry / "__init__.py" if entry.is_dir() else entry
    if entry.name.startswith((".", "__")) or entry.stem.endswith("_disabled"):
        return None
    if file.suffix == ".py" and not file.is_file():
        info(f"{entry} is no extension: {file} is no file")
    return file if file.suffix == ".py" and file.is_file() else None


def _load(entry: Path, file: Path) -> str:
    name = entry.name if entry.is_dir() else f"custom/{entry.stem}"
    loaded = sys.modules.get(name)
    if loaded is not None and Path(loaded.__file__ or "").resolve() == file.resolve():
        return name
    installed = PathFinder.find_spec(name) if entry.is_dir() else None
    if installed and installed.origin or name in sys.stdlib_module_names:
        raise UserError(f"the extension {entry} has the name of a module: rename the folder")
    spec = importlib.util.spec_from_file_location(name, file.resolve())
    sys.modules[name] = module = importlib.util.module_from_spec(spec)
    try:
        spec.loader.exec_module(module)
    except (Exception, SystemExit) as error:
        del sys.modules[name]
        if isinstance(error, Terminated):
            raise
        frames, root = traceback.extract_tb(error.__traceback__), str(entry.resolve())
        places = [f"{f.filename}:{f.lineno}: " for f in frames if f.filename.startswith(root)]
        if isinstance(error, SyntaxError) and error.lineno:
            places.append(f"{error.filename}:{error.lineno}: ")
        raise UserError(
            f"the extension {entry} can't be imported: {''.join(places[-1:])}"
            f"{type(error).__name__}: {error}"
        ) from error
    return name
