"""Read the Gaussians of any file: those of the known formats, and training checkpoints."""

from collections.abc import Mapping
from pathlib import Path
from typing import Optional

import torch
from torch import Tensor

from ..core.checkpoint_file import load_file
from ..core.errors import UserError
from ..formats.gaussian_files import READ, StoredCloud, read_cloud, require_format
from ..gaussians.axes import WORLD_UP
from ..gaussians.gaussians import Gaussians, drawable
from ..gaussians.stored_state import require_cloud
from .run_files import RunFiles

CHECKPOINT_ENDINGS = (".ckpt", ".pt", ".pth")
CHECKPOINTS = {
    "state_dict": {
        name: f"geometry.{name}"
        for name in ("means", "quats", "log_scales", "logit_opacities", "sh0", "sh_rest")
    },
    "splats": {
        "means": "means",
        "quats": "quats",
        "log_scales": "scales",
        "logit_opacities": "opacities",
        "sh0": "sh0",
        "sh_rest": "shN",
    },
}
"""The names of the Gaussians' tensors in checkpoints of this package and of gsplat's trainer."""


def read_any(source: Path, up: Optional[str] = None, option: str = "PATH") -> StoredCloud:
    """Read the Gaussians of a file or checkpoint, without those that can't be drawn. A checkpoint
    in the folder of a run was trained with the run's antialiasing.

    Args:
        up: overrides the up axis that the file states.
        option: names the argument in messages.

    Raises:
        UserError: the file is none of Gaussians, or damaged.
    """
    if source.suffix in CHECKPOINT_ENDINGS:
        gaussians, run = drawable(from_checkpoint(source), str(source)), RunFiles.around(source)
        antialiased = run is not None and run.antialiased
        return StoredCloud(gaussians, up or WORLD_UP, antialiased=antialiased)
    require_format(source.name, option, READ)
    return read_cloud(str(source), up=up)


def from_checkpoint(file: Path) -> Gaussians:
    """Read the Gaussians of a training checkpoint.

    Raises:
        UserError: it has none.
    """
    content = load_file(file)
    for key, names in CHECKPOINTS.items():
        state = content.get(key) if isinstance(content, dict) else None
        state = state if isinstance(state, Mapping) else {}
        if all(isinstance(state.get(stored), Tensor) for stored in names.values()):
            require_cloud(state, names, str(file), allow_non_finite=True)
            values = {name: state[stored].detach().float() for name, stored in names.items()}
            harmonics = torch.cat([values.pop("sh0"), values.pop("sh_rest")], 1)
            return Gaussians(sh=harmonics, **values).arrays()
    raise UserError(
        f"{file} holds no cloud of Gaussians: it has neither {CHECKPOINTS['state_dict']['means']} "
        "nor gsplat's splats"
    )
