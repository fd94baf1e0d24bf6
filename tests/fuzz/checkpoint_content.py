"""Generator of invalid checkpoints with valid checksums: one value anywhere in the content is
replaced, removed, or exchanged with another one."""

import copy
import io
import math
import tempfile
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from tests.helpers.checkpoints import whole_checkpoint
from threestudio_gaussiandreamer.core.checkpoint_file import load_checkpoint, save_file
from threestudio_gaussiandreamer.launch.stage_errors import lightning_errors
from threestudio_gaussiandreamer.launch.training_state import check_training_state
from threestudio_gaussiandreamer.training.geometry import GaussianCloud
from threestudio_gaussiandreamer.training.system import GaussianDreamerSystem

VALUES: list[Any] = [
    *(None, True, False, 0, 1, -1, 3, 2**31, 2**63, 10**20, 10**400, -(10**400), 0.5, 1e39),
    *(math.nan, math.inf, -math.inf, "", "x", "2.0.0", [], [1], {}, {"a": 1}, {0: {}}, (), (0, 1)),
    *(torch.zeros(()), torch.zeros(0), torch.zeros(3), torch.full((10, 3), math.nan)),
    *(torch.zeros(10, 3), torch.zeros(10, 3, dtype=torch.long), torch.zeros(2, 2, 2)),
    torch.zeros(10, dtype=torch.bool),
]
TENSORS: list[Callable[[Tensor], Tensor]] = [
    *(lambda t: t[:0], lambda t: t[..., :0], lambda t: t.repeat(2, *[1] * (t.dim() - 1))),
    *(lambda t: t[:3], lambda t: t * math.nan, lambda t: t * math.inf, lambda t: t * 1e38),
    *(lambda t: t.double(), lambda t: t.half(), lambda t: t.long(), lambda t: t.bool()),
    *(lambda t: t[None], lambda t: t.flatten(), lambda t: -t, lambda t: t.to(torch.complex64)),
    *(lambda t: t.to_sparse(), lambda t: t[:1].expand(10**6, *t.shape[1:]), lambda t: t.T),
]
"""Changes of a tensor; one that doesn't apply to its shape leaves it unchanged."""


@cache
def seeds() -> list[bytes]:
    return [_bytes(whole_checkpoint()), _bytes(whole_checkpoint(count=3, steps=0))]


def _bytes(content: Any) -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "a.ckpt")
        save_file(path, content)
        return path.read_bytes()


def other_content(data: bytes, rng: np.random.Generator) -> bytes:
    """Replace one value."""
    try:
        content = torch.load(io.BytesIO(data), weights_only=True)
    except Exception:  # spliced
        return data
    places = list(_places(content))
    if not places:
        return _bytes(VALUES[rng.integers(len(VALUES))])
    holder, key = places[rng.integers(len(places))]
    action = rng.random()
    if action < 0.15 and isinstance(holder, dict):
        del holder[key]
    elif action < 0.25:
        other, name = places[rng.integers(len(places))]
        holder[key] = copy.deepcopy(other[name])
    elif action < 0.6 and isinstance(holder[key], Tensor):
        holder[key] = _changed(holder[key], TENSORS[rng.integers(len(TENSORS))])
    else:
        holder[key] = VALUES[rng.integers(len(VALUES))]
    return _bytes(content)


def _changed(tensor: Tensor, change: Callable[[Tensor], Tensor]) -> Tensor:
    try:
        return change(tensor)
    except (RuntimeError, IndexError, TypeError):
        return tensor


def _places(content: Any) -> Iterator[tuple[Any, Any]]:
    """Every (container, key); containers are dicts and lists."""
    if isinstance(content, (dict, list)):
        for key in list(content) if isinstance(content, dict) else range(len(content)):
            yield content, key
            yield from _places(content[key])


def geometry_of(checkpoint: dict[str, Any], path: Path) -> GaussianCloud:
    """Return the cloud of a checkpoint that was read from ``path``."""
    geometry = GaussianCloud({})
    state = {
        key.removeprefix("geometry."): value
        for key, value in checkpoint["state_dict"].items()
        if key.startswith("geometry.")
    }
    with lightning_errors(str(path)):
        geometry.load_state_dict(state)
    return geometry


def exercise(path: Path, require: Callable[[GaussianCloud], None]) -> None:
    """What is accepted goes on: the cloud is drawn, and steps with its optimiser.

    Args:
        require: draws a cloud and fails unless all is finite.
    """
    checkpoint = load_checkpoint(path)
    GaussianDreamerSystem.check_checkpoint(checkpoint, str(path))
    for key in ("loops", "optimizer_states"):
        checkpoint.setdefault(key, None)  # the launcher asks for them before
    check_training_state(checkpoint, {"name": "Adam"}, str(path))
    geometry = geometry_of(checkpoint, path)
    with lightning_errors(str(path)):
        optimizer = torch.optim.Adam(geometry.parameter_groups(), lr=1e-3)
        optimizer.load_state_dict(checkpoint["optimizer_states"][0])
    if len(geometry):
        require(geometry)
        optimizer.step()
