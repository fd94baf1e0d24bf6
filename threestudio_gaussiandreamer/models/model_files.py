"""Select the needed files of a model in diffusers' or transformers' format, load them, and keep
networks for processes with several runs. A model of several components has a sub-folder for each
(``unet``, ``vae``, ``text_encoder``, ...); the component of a single network is "". Weights are
read from safetensors; if a caller allows ``.bin`` files, they are read with ``weights_only``. Also
checkpoints of one network, of any program."""

import gc
import hashlib
import json
import pickle
import re
import textwrap
import zipfile
from collections import Counter
from collections.abc import Callable, Collection, Hashable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple, Optional

from ..core.errors import UserError
from ..core.extras import require_extra
from ..formats.reading import Unreadable, reading, require

WITHOUT_WEIGHTS = {
    **dict.fromkeys(("tokenizer", "tokenizer_2", "tokenizer_3"), "tokenizer_config.json"),
    "scheduler": "scheduler_config.json",
}
"""Components without weights, and the file that each must have."""
VOCABULARIES = ({"tokenizer.json"}, {"vocab.json", "merges.txt"}, {"spiece.model"})
"""Alternative sets of files that hold a tokenizer's vocabulary; one complete set is enough."""
WEIGHTS = re.compile(
    r"(?:diffusion_pytorch_model|model)(?:\.(?P<early>fp16|bf16))?"
    r"(?:-\d{5}-of-(?P<shards>\d{5}))?(?:\.(?P<late>fp16|bf16))?\.safetensors"
)
"""The variant may precede or follow the number of the shard."""
HALF_VARIANTS = ("fp16", "bf16")
PICKLED = ("diffusion_pytorch_model.bin", "pytorch_model.bin")
SAMPLE = 1 << 16
"""Bytes of each of the sixteen samples of a weight file that enter its fingerprint."""


class Weights(NamedTuple):
    """One complete set of weight files of a component: safetensors if they are ``safe``."""

    files: list[str]
    variant: Optional[str]
    safe: bool


def files_below(folder: Path) -> list[str]:
    """List the files of a model's folder, as paths relative to it ("unet/config.json")."""
    files = (path for path in folder.rglob("*") if path.is_file())
    return sorted(path.relative_to(folder).as_posix() for path in files)


def needed_files(
    names: Collection[str], components: Iterable[str], *, half=False, allow_bin=None
) -> list[str]:
    """Return the files that are read to load these components, of which "" is a network with its
    tokenizer; see :func:`component_weights`. Raise UserError with all that are missing.
    """
    needed, problems = ["model_index.json"] if "model_index.json" in names else [], []
    for component in components:
        prefix, own = _own(names, component)
        settings = WITHOUT_WEIGHTS.get(component, "config.json")
        if settings not in own:
            problems.append(f"{prefix}{settings} is missing")
            continue
        has_tokenizer = component in WITHOUT_WEIGHTS.keys() - {"scheduler"} or not component
        if has_tokenizer and not any(vocabulary <= set(own) for vocabulary in VOCABULARIES):
            other = f"{prefix}vocab.json and {prefix}merges.txt"
            problems.append(f"the tokenizer's {prefix}tokenizer.json, or {other}, are missing")
        needed += [prefix + name for name in own if name.endswith((".json", ".txt", ".model"))]
        if component not in WITHOUT_WEIGHTS:
            try:
                needed += component_weights(names, component, half=half, allow_bin=allow_bin).files
            except UserError as error:
                problems.append(str(error))
    if problems:
        raise UserError("; ".join(problems))
    return needed


def component_weights(
    names: Collection[str], component: str, *, half: bool = False, allow_bin: Optional[bool] = None
) -> Weights:
    """Select the weight files of one component: in half precision if that is preferred and the set
    is complete, else in the other one; with ``allow_bin`` also ``.bin`` files (None: there is no
    such option, which messages could suggest). Raise UserError if there is no complete set.
    """
    prefix, own = _own(names, component)
    for variant in (*HALF_VARIANTS, None) if half else (None, *HALF_VARIANTS):
        if files := _complete_set(own, variant):
            return Weights([prefix + name for name in files], variant, True)
    pickled = [prefix + name for name in own if name in PICKLED]
    if allow_bin and pickled:
        return Weights(pickled[:1], None, False)
    problem = f"{prefix}*.safetensors, the weights, are missing"
    if any(name.endswith(".safetensors") for name in own):
        problem = f"some of {prefix}*.safetensors are missing"
    elif any(name.endswith((".bin", ".pt", ".pth", ".ckpt")) for name in own):
        hint = ", or set allow_bin: true, which reads a .bin with PyTorch's weights_only loader"
        problem = (
            f"{prefix} has pickled weights only, which could run code: save it again with "
            f"safe_serialization=True{'' if allow_bin is None else hint}"
        )
    raise UserError(problem)


def _own(names: Collection[str], component: str) -> tuple[str, list[str]]:
    """Return the prefix "unet/" of a component's files, and their names without it."""
    prefix = f"{component}/" if component else ""
    own = [name.removeprefix(prefix) for name in names if name.startswith(prefix)]
    return prefix, [name for name in own if "/" not in name]


def _complete_set(own: list[str], variant: Optional[str]) -> list[str]:
    """Return the single weight file, or all shards; an empty list if some are missing."""
    matches = [match for match in map(WEIGHTS.fullmatch, own) if match]
    found = [match for match in matches if (match["early"] or match["late"]) == variant]
    single = [match.string for match in found if match["shards"] is None]
    if single or not found:
        return single[:1]
    whole = len(found) == int(found[0]["shards"])
    return sorted(match.string for match in found) if whole else []


def pipeline_settings(folder: Path) -> dict[str, Any]:
    """Return the content of ``model_index.json``; an empty object if there is none."""
    index = folder / "model_index.json"
    return json.loads(index.read_text(encoding="utf-8")) if index.is_file() else {}


def fingerprint(folder: Path, components: Iterable[str]) -> str:
    """Return a digest of the components; of files above 1 MiB, of size and 16 samples."""
    digest = hashlib.sha256()
    for component in sorted(components):
        for path in sorted(path for path in (folder / component).rglob("*") if path.is_file()):
            size, name = path.stat().st_size, path.relative_to(folder / component).as_posix()
            digest.update(f"{component}/{name}/{size}\0".encode())
            with open(path, "rb") as file:
                for start in range(0, size, max(SAMPLE, size // 16)):
                    file.seek(start)
                    digest.update(file.read(SAMPLE))
    return digest.hexdigest()


def load_network(
    loader: Any, folder: Path, component: str = "", *, half=False, allow_bin=None, **options: Any
) -> Any:
    """Return a network on the CPU, in evaluation mode, loaded from local files with diffusers' or
    transformers' ``from_pretrained``, which gets ``options``; for the others see
    :func:`component_weights`. Raise UserError if files are damaged or lack weights.
    """
    from transformers.utils import logging

    weights = component_weights(files_below(folder), component, half=half, allow_bin=allow_bin)
    options |= {"use_safetensors": weights.safe, "variant": weights.variant}
    options["output_loading_info"], level = True, logging.get_verbosity()
    # no report of weights that the network doesn't have, as those of CLIP's other encoder
    logging.set_verbosity_error()
    try:
        network, report = load_settings(loader, folder, component, **options)
    finally:
        logging.set_verbosity(level)
    # if weights are missing, both libraries only warn and initialise them at random
    if missing := sorted(report["missing_keys"]):
        some = f"{', '.join(missing[:3])}{', ...' if missing[3:] else ''}"
        name = f"{component or loader.__name__} of the model in {str(folder)!r}"
        raise UserError(f"{name} lacks weights: {some}")
    return network.eval()


def load_settings(loader: Any, folder: Path, component: str = "", **options: Any) -> Any:
    """Load a tokenizer or a scheduler with ``from_pretrained`` from local files."""
    options |= {"subfolder": component, "local_files_only": True}
    with loading_errors(f"{component or loader.__name__} of the model in {str(folder)!r}"):
        return loader.from_pretrained(str(folder), **options)


@contextmanager
def loading_errors(name: str) -> Iterator[None]:
    """Raise UserError for any error while ``name``, a component of a model, is loaded."""
    try:
        yield
    except UserError:
        raise
    except Exception as error:  # OSError, ValueError, RuntimeError, SafetensorError, ImportError
        said = f"{type(error).__name__}: {str(error).strip()[:500]}"
        advice = "If a file is damaged, delete it and download it again."
        raise UserError(f"{name} can't be loaded: {said}. {advice}") from error


_kept: Optional[dict[Hashable, Any]] = None
"""By key; None where networks aren't kept."""
_counts: Counter = Counter()


def keep_loaded(keep: bool = True) -> None:
    """Keep networks from now on, for processes with several runs, or drop those that were kept."""
    global _kept
    _kept = (_kept or {}) if keep else None
    _counts.clear()


def loaded(key: tuple[Hashable, ...], load: Callable[[], Any]) -> Any:
    """Return ``load()``, or what it returned earlier for ``key``, if networks are kept: the name
    for :func:`load_counts`, and all that ``load`` depends on.
    """
    kept = {} if _kept is None else _kept
    if key not in kept:
        kept[key] = load()
        _counts[str(key[0])] += 1
    return kept[key]


def load_counts() -> dict[str, int]:
    """Return how often each network was loaded since :func:`keep_loaded`, by name."""
    return dict(_counts)


def free_memory() -> None:
    """Collect garbage, and release the GPU memory that PyTorch's allocator has cached."""
    import torch

    gc.collect()
    if torch.cuda.is_available():
        torch.cuda.empty_cache()


# Checkpoints of one network -----------------------------------------------------------------------

WRAPPERS = "model_state_dict", "model_avg", "model"
"""Keys of the weights in training checkpoints, averaged ones first."""


def read_state_dict(path: str, kind: str) -> dict[str, Any]:
    """Return the tensors of a checkpoint by name: of a ``.safetensors`` file, or of a pickle, which
    is read with ``weights_only``, so that it can't run code.

    Raises:
        UserError: the file (``kind`` names it) is missing, refused, or holds no tensors by name.
    """
    import torch

    with reading(path, kind) as file:
        if file.suffix == ".safetensors":
            require_extra("diffusion", "safetensors")
            from safetensors.torch import load_file

            content = load_file(file)
        else:  # zip files are memory-mapped, so that unused tensors (optimiser state) aren't read
            mapped = zipfile.is_zipfile(file)
            try:
                content = torch.load(file, map_location="cpu", weights_only=True, mmap=mapped)
            except pickle.UnpicklingError as error:  # torch's message recommends to run it
                unsafe = "it is no file of PyTorch, or has more than tensors, which could run code"
                raise Unreadable(unsafe) from error
        state = content if isinstance(content, Mapping) else {}
        state = next((state[key] for key in WRAPPERS if isinstance(state.get(key), Mapping)), state)
        weights = bool(state) and all(isinstance(value, torch.Tensor) for value in state.values())
        expected = f"a state dict, or a dict with {WRAPPERS[0]!r}, was expected"
        require(weights, f"it holds no weights by name: {expected}")
        return dict(state)


def load_exactly(module: Any, state: Mapping[str, Any], what: str) -> None:
    """Load ``state``, converted to its dtype; raise UserError if names or shapes differ."""
    try:
        module.load_state_dict(state)
    except RuntimeError as error:
        problems = textwrap.shorten(str(error).partition(":")[2], 400)
        raise UserError(f"{what} does not fit the model: {problems}") from error
