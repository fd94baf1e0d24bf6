"""What tells one farm from another: a folder's ``farm.json`` names the configuration that all its
assets are made with."""

import hashlib
import json
from pathlib import Path
from typing import Any

from .. import __version__
from ..core.errors import UserError
from ..core.files import json_text
from .assets import Recipe
from .storage import Place

FILE = "farm.json"
OF_MACHINES = ("device", "cores")
"""Entries of :func:`identity` that are known only when Ray has told which machines there are."""


def identity(recipe: Recipe) -> dict[str, Any]:
    """Return what the assets of a farm depend on beside their rows."""
    return {
        "version": __version__,
        "configurations": [
            f"{Path(source.name).name} {hashlib.sha256(source.content).hexdigest()[:16]}"
            for source in recipe.sources
        ],
        "overrides": list(recipe.overrides),
        "device": "cpu" if recipe.cpu else "gpu",
        "cores": recipe.cores if recipe.cpu else None,
    }


def require_farm(place: Place) -> None:
    """Raise UserError unless a farm has been started in a folder."""
    if place.read(FILE) is None:
        raise UserError(f"there is no farm in {place}: it has no {FILE}; check --out")


def require_same_farm(place: Place, recipe: Recipe) -> None:
    """Check that a folder is new or of the same farm, and note the farm in a new one.

    Raises:
        UserError: the folder belongs to another farm; the message names what differs.
    """
    ours = identity(recipe)
    if not _require_entries(place, ours):
        place.write(FILE, json_text(ours, indent=1).encode())


def require_same_recipe(place: Place, recipe: Recipe) -> None:
    """Check the same before Ray has told which machines there are, and note nothing.

    Raises:
        UserError: the folder belongs to another farm; the message names what differs.
    """
    ours = identity(recipe)
    _require_entries(place, {name: ours[name] for name in ours if name not in OF_MACHINES})


def _require_entries(place: Place, ours: dict[str, Any]) -> bool:
    """Check that a folder's farm, if it has one, has these entries of :func:`identity`; return
    whether it has one.
    """
    content = place.read(FILE)
    if content is None:
        return False
    try:
        theirs = json.loads(content)
        differs = [name for name in ours if theirs.get(name) != ours[name]]
    except (ValueError, AttributeError) as error:
        raise UserError(f"{place}/{FILE} is damaged: {error}; choose another --out") from error
    if differs:
        name = differs[0]
        there, here, note = theirs.get(name), ours[name], ""
        if isinstance(there, list) and isinstance(here, list):
            only_there = [item for item in there if item not in here]
            only_here = [item for item in here if item not in there]
            # else only their order differs, or nothing is in both
            if (only_there or only_here) and (only_there, only_here) != (there, here):
                there, here, note = only_there, only_here, " (without what is in both)"
        raise UserError(
            f"{place} belongs to another farm: its {name} is {shown(there)}, here "
            f"{shown(here)}{note}; choose another --out"
        )
    return True


def shown(value: Any) -> str:
    text = json.dumps(value)
    return text if len(text) <= 300 else f"{text[:300]}..."
