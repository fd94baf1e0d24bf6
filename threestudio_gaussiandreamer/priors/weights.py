"""Read published ``.pt`` and ``.pth`` files of weights, and ``.safetensors``: tensors only, whose
names must match those of the network exactly.
"""

import pickle
import zipfile
from collections.abc import Mapping

import torch
from torch import Tensor, nn

from ..core.errors import UserError
from ..core.files import existing_file

WRAPPER = "model_state_dict"
"""The key of the weights in training checkpoints, which have further entries."""


def read_state_dict(path: str, kind: str) -> dict[str, Tensor]:
    """Return the tensors of a checkpoint by name: of a ``.safetensors`` file, or of a pickle, which
    is read with ``weights_only``, so that it can't run code.

    Args:
        kind: what the file is, for messages ("Shap-E checkpoint").

    Raises:
        UserError: the file is missing, unreadable, refused, or holds no tensors by name.
    """
    file = existing_file(path, kind)
    try:
        if file.suffix == ".safetensors":
            from safetensors.torch import load_file

            content = load_file(file)
        else:  # zip files are memory-mapped, so that unused tensors (optimiser state) aren't read
            mapped = zipfile.is_zipfile(file)
            content = torch.load(file, map_location="cpu", weights_only=True, mmap=mapped)
    except Exception as error:  # torch raises various exceptions for damaged pickles
        problem = f"can't be read: {type(error).__name__}"
        if isinstance(error, pickle.UnpicklingError):
            problem = (
                "holds more than tensors, or is no file of PyTorch, and is not unpickled, since "
                "that could run code"
            )
        reason = str(error).strip().partition("\n")[0][:200]
        raise UserError(f"{kind} {path!r} {problem}: {reason}") from error
    state = content.get(WRAPPER, content) if isinstance(content, Mapping) else {}
    if not state or not all(isinstance(value, Tensor) for value in state.values()):
        raise UserError(
            f"{kind} {path!r} holds no weights by name: a state dict, or a dict with "
            f"{WRAPPER!r}, was expected"
        )
    return dict(state)


def load_exactly(module: nn.Module, state: Mapping[str, Tensor], what: str) -> None:
    """Load ``state`` into ``module``, converted to its dtype.

    Raises:
        UserError: names are missing or unknown, or shapes differ; the message lists some of them.
    """
    try:
        module.load_state_dict(state)
    except RuntimeError as error:
        problems = " ".join(str(error).split()).partition(": ")[2]
        problems = problems if len(problems) < 400 else f"{problems[:400]} ..."
        raise UserError(f"{what} does not fit the model: {problems}") from error
