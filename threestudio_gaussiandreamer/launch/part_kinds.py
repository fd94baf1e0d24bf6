"""Which kind of part the key of a section names."""

from pathlib import Path
from typing import Any, Optional

from torch import nn

from ..core.errors import UserError
from ..core.methods import find_method, require_method
from ..exporters.files import require_export
from ..guidance.base import ScoreDistillation
from ..guidance.variants import Variant
from ..host import (
    BaseBackground,
    BaseGeometry,
    BaseMaterial,
    Exporter,
    Rasterizer,
    find,
    names,
    pl,
)
from ..priors.base import Prior
from ..prompts.prompt_processors import TextEncoderPromptProcessor
from ..training.density import DensityRule
from ..training.losses import SUFFIX

KINDS: dict[str, type] = {
    "data": pl.LightningDataModule,
    "system": pl.LightningModule,
    "geometry": BaseGeometry,
    "material": BaseMaterial,
    "background": BaseBackground,
    "renderer": Rasterizer,
    "exporter": Exporter,
    "prior": Prior,
    "density": DensityRule,
    "guidance": ScoreDistillation,
    "variant": Variant,
    "prompt_processor": TextEncoderPromptProcessor,
}
"""The base class of each kind of part, by the name of its section.

Parts of other packages may have other base classes; a part is refused only if it derives from the
base class of a different kind.
"""


CALLS = {"guidance": "rgb", "background": "dirs"}
"""The first argument of a call, of the kinds that other packages write without our base class."""


CUSTOM_HINT = (
    " (own parts are imported from the folder custom in the working folder, which has none; a "
    "run's folder has a copy in code)"
)


def find_part(path: str, type_name: Any) -> type:
    """Return the part that the key ``path`` names; the message of an error names the key too."""
    if not type_name:
        hint = ""
        if path == "data_type":
            hint = " (an overlay needs the configuration that it changes before it)"
        raise UserError(f"{path} is empty: name a registered part{hint}")
    if not isinstance(type_name, str):
        raise UserError(f"{path} is {type_name!r}; expected the name of a registered part")
    try:
        return find(type_name)
    except UserError as error:
        hint = "" if Path("custom").is_dir() else CUSTOM_HINT
        raise UserError(f"{path}: {error}{hint}") from error


def check_kind(path: str, type_name: str, part: Any) -> None:
    """Raise UserError if the part of a section is known to be of another kind, or can't be one."""
    if not isinstance(part, type):
        raise UserError(f"{path}: {type_name} is a {type(part).__name__}; register a class")
    kind = path.rpartition(".")[2].removesuffix("_type")
    found = _kind_of(part)
    if found in (None, kind):
        _require_call(path, kind, part)
    if kind not in KINDS or found in (None, kind):
        return
    choices = [name for name in names() if _kind_of(find(name)) == kind]
    raise UserError(
        f"{path} is {type_name!r}, a part of the kind {found}; expected one of the kind {kind}: "
        f"choose from {', '.join(choices)}"
    )


def parts_by_kind() -> dict[str, list[str]]:
    """Return the names of the registered parts; the kind "other" has those without a base class
    that tells theirs, such as guidances that are plain objects.
    """
    found: dict[str, list[str]] = {}
    for name in names():
        is_loss = name.endswith(SUFFIX)
        kind = "regulariser" if is_loss else _kind_of(find(name)) or "other"
        found.setdefault(kind, []).append(name)
    return {kind: found[kind] for kind in (*KINDS, "regulariser", "other") if kind in found}


def _require_call(path: str, kind: str, part: type) -> None:
    """Raise UserError for a guidance, exporter or background that can't be called."""
    call = "forward" if issubclass(part, nn.Module) else "__call__"
    # these only raise an error
    missing = find_method(part, call) in (nn.Module.forward, BaseBackground.forward)
    try:
        if kind in CALLS and missing:
            raise UserError(f"{part.__name__} has no {call}({CALLS[kind]}, ...)")
        if kind in CALLS:
            require_method(part, call, CALLS[kind], more=True)
        if kind == "exporter":
            require_export(part)
    except UserError as error:
        raise UserError(f"{path}: {error}") from error


def _kind_of(part: Any) -> Optional[str]:
    kinds = (kind for kind, base in KINDS.items() if isinstance(part, type))
    # of threestudio's parts, the base class of threestudio
    bases = {kind: vars(base).get("HOST", base) for kind, base in KINDS.items()}
    return next((kind for kind in kinds if issubclass(part, bases[kind])), None)
