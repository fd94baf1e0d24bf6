"""The recipe that the charts change option by option: recipe.yaml over configs/demo.yaml."""

from pathlib import Path
from typing import Any

from omegaconf import OmegaConf

CONFIGS = Path(__file__).resolve().parents[2] / "configs"
RECIPE = Path(__file__).with_name("recipe.yaml")


def recipe() -> dict[str, Any]:
    """Return the recipe's configuration; references to other keys aren't resolved."""
    parts = (OmegaConf.load(path) for path in (CONFIGS / "demo.yaml", RECIPE))
    return OmegaConf.to_container(OmegaConf.merge(*parts))
