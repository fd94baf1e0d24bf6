"""What a model's folder holds in the formats of diffusers and transformers, which of its files are
needed, and loading them.

A model of several components has a sub-folder for each (``unet``, ``vae``, ``text_encoder``, ...);
one of a single network has its files in the folder itself, and that component is called "". Weights
are read from safetensors, since a pickle could run code; where a caller allows a ``.bin``, it is
read with ``weights_only``."""

import gc
import hashlib
import re
from collections.abc import Collection, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple, Optional

from ..core.errors import UserError

WITHOUT_WEIGHTS = {"tokenizer": "tokenizer_config.json", "scheduler": "scheduler_config.json"}
"""Components that are all configuration, and the file that they can't be without."""
VOCABULARIES = ({"tokenizer.json"}, {"vocab.json", "merges.txt"}, {"spiece.model"})
"""What the words of a tokenizer may be in."""
WEIGHTS = re.compile(
    r"(?:diffusion_pytorch_model|model)(?P<early>\.fp16)?(?:-\d{5}-of-(?P<shards>\d{5}))?(?P<late>\.fp16)?\.safetensors"
)
PICKLED = ("diffusion_pytorch_model.bin", "pytorch_model.bin")
SAMPLE = 1 << 16
"""Bytes of each of the sixteen places at which a weight file is sampled for its fingerprint."""


class Weights(NamedTuple):
    """One complete set of weight files of a component."""

    files: list[str]
    variant: Optional[str]
    """None or "fp16"."""
    safe: bool
    """Whether it is safetensors."""


def files_below(folder: Path) -> list[str]:
    """The files of a model's folder, as paths relative to it ("unet/config.json")."""
    return sorted(
        path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file()
    )


def needed_files(
    names: Collection[str],
    components: Iterable[str],
    *,
    half: bool = False,
    allow_bin: Optional[bool] = None,
) -> list[str]:
    """Those of a model's files that loading these components reads; see :func:`component_weights`.

    Raises:
        UserError: they aren't all there; the message names what each component lacks.
    """
    needed, problems = ["model_index.json"] if "model_index.json" in names else [], []
    for component in components:
        try:
            needed += component_files(names, component, half=half, allow_bin=allow_bin)
        except UserError as error:
            problems.append(str(error))
    if problems:
        raise UserError("; ".join(problems))
    return needed


def component_files(
    names: Collection[str], component: str, *, half: bool = False, allow_bin: Optional[bool] = None
) -> list[str]:
    """The files that loading one component reads.

    Raises:
        UserError: they aren't all there.
    """
    prefix, own = _own(names, component)
    small = [prefix + name for name in own if name.endswith((".json", ".txt", ".model"))]
    needed = WITHOUT_WEIGHTS.get(component, "config.json")
    if needed not in own:
        raise UserError(f"{prefix}{needed} is missing")
    if component == "tokenizer":
        require_vocabulary(names, component)
    return (
        small
        if component in WITHOUT_WEIGHTS
        else small + component_weights(names, component, half=half, allow_bin=allow_bin).files
    )


def require_vocabulary(names: Collection[str], component: str) -> None:
    """Raise UserError unless a tokenizer's words are among ``names``."""
    prefix, own = _own(names, component)
    if not any(vocabulary <= set(own) for vocabulary in VOCABULARIES):
        raise UserError(
            f"the tokenizer's {prefix}tokenizer.json, or {prefix}vocab.json and "
            f"{prefix}merges.txt, are missing"
        )


def component_weights(
    names: Collection[str], component: str, *, half: bool = False, allow_bin: Optional[bool] = None
) -> Weights:
    """The weight files of one component: of the wanted precision where that set is complete, else
    of the other one.

    Args:
        half: prefer half-precision files where there are both.
        allow_bin: take a ``.bin`` where there is nothing else; None: as False, where no option of
            the user's is called so.

    Raises:
        UserError: no complete set of files that may be read.
    """
    prefix, own = _own(names, component)
    complete = {}
    for variant in (None, "fp16"):
        files = _complete_set(own, variant)
        if files:
            complete[variant] = Weights([prefix + name for name in files], variant, True)
    if complete:
        return complete.get("fp16" if half else None) or next(iter(complete.values()))
    pickled = [prefix + name for name in own if name in PICKLED]
    if allow_bin and pickled:
        return Weights(pickled[:1], None, False)
    raise UserError(_without_weights(prefix, own, allow_bin))


def _own(names: Collection[str], component: str) -> tuple[str, list[str]]:
    """The prefix of a component's files, and what follows it in the names of those that lie
    directly there.
    """
    prefix = f"{component}/" if component else ""
    own = [name.removeprefix(prefix) for name in names if name.startswith(prefix)]
    return prefix, [name for name in own if "/" not in name]


def _complete_set(own: list[str], variant: Optional[str]) -> list[str]:
    """One file, or all shards; empty when some are missing."""
    matches = {name: WEIGHTS.fullmatch(name) for name in own}
    found = {
        name: match
        for name, match in matches.items()
        if match and bool(match["early"] or match["late"]) == (variant == "fp16")
    }
    whole = [name for name, match in found.items() if match["shards"] is None]
    if whole:
        return whole[:1]
    shards = sorted(found)
    return shards if shards and len(shards) == int(found[shards[0]]["shards"]) else []


def _without_weights(prefix: str, own: list[str], allow_bin: Optional[bool]) -> str:
    if any(name.endswith(".safetensors") for name in own):
        return f"some of {prefix}*.safetensors are missing"
    if any(name.endswith((".bin", ".pt", ".pth", ".ckpt")) for name in own):
        hint = (
            ""
            if allow_bin is None
            else ", or set allow_bin: true, which reads a .bin with PyTorch's weights_only loader"
        )
        return (
            f"{prefix} has pickled weights only, which could run code: save it again with "
            f"safe_serialization=True{hint}"
        )
    return f"{prefix}*.safetensors, the weights, are missing"


def fingerprint(folder: Path, components: Iterable[str]) -> str:
    """A digest of what these components are, whatever the folder is called: small files whole,
    weight files sampled with their size.

    Sixteen samples of 64 KiB tell two sets of trained weights apart in milliseconds; they don't
    find a single changed byte."""
    digest = hashlib.sha256()
    for component in sorted(components):
        for path in sorted(path for path in (folder / component).rglob("*") if path.is_file()):
            size = path.stat().st_size
            digest.update(
                f"{component}/{path.relative_to(folder / component).as_posix()}/{size}\0".encode()
            )
            with open(path, "rb") as file:
                for start in range(0, size, max(SAMPLE, size // 16)):
                    file.seek(start)
                    digest.update(file.read(SAMPLE))
    return digest.hexdigest()


# Loading
# --------------------------------------------------------------------------------------------------


def load_network(
    loader: Any,
    folder: Path,
    component: str = "",
    *,
    half: bool = False,
    allow_bin: Optional[bool] = None,
    **options: Any,
) -> Any:
    """One network by ``from_pretrained`` of diffusers or transformers, from this disk, in
    evaluation mode, on the CPU.

    Args:
        half, allow_bin: see :func:`component_weights`.
        options: more for ``from_pretrained``, such as the type of the weights.

    Raises:
        UserError: its files are damaged, lack weights, or are not what the libraries expect.
    """
    weights = component_weights(files_below(folder), component, half=half, allow_bin=allow_bin)
    options |= {
        "use_safetensors": weights.safe,
        "variant": weights.variant,
        "output_loading_info": True,
    }
    with _quiet_transformers():
        network, report = _from_pretrained(loader, folder, component, options)
    # both libraries would go on with random numbers, after a warning
    if missing := sorted(report["missing_keys"]):
        raise UserError(
            f"{_name(loader, folder, component)} lacks weights: "
            f"{', '.join(missing[:3])}{', ...' if missing[3:] else ''}"
        )
    return network.eval()


def load_settings(loader: Any, folder: Path, component: str = "", **options: Any) -> Any:
    """A tokenizer or a scheduler by ``from_pretrained``, from this disk.

    Raises:
        UserError: its files are damaged or not what the libraries expect.
    """
    return _from_pretrained(loader, folder, component, options)


def _from_pretrained(loader: Any, folder: Path, component: str, options: dict[str, Any]) -> Any:
    try:
        return loader.from_pretrained(
            str(folder), subfolder=component, local_files_only=True, **options
        )
    except Exception as error:  # OSError, ValueError, RuntimeError, SafetensorError, ImportError
        raise UserError(
            f"{_name(loader, folder, component)} can't be loaded: {type(error).__name__}: "
            f"{str(error).strip()[:500]}. "
            "If a file is damaged, delete it and download it again."
        ) from error


def _name(loader: Any, folder: Path, component: str) -> str:
    return f"{component or loader.__name__} of the model in {str(folder)!r}"


@contextmanager
def _quiet_transformers() -> Iterator[None]:
    """Without its table of the weights that a file has and the wanted part doesn't, as a whole
    CLIP's for its text half.
    """
    from transformers.utils import logging

    level = logging.get_verbosity()
    logging.set_verbosity_error()
    try:
        yield
    finally:
        logging.set_verbosity(level)


def free_memory() -> None:
    """Give back what models held that nothing refers to any more, also on the GPU."""
    import torch

    gc.collect()
    if torch.cuda.is_available():
        torch.cuda.empty_cache()
