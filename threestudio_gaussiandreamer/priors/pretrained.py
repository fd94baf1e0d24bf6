"""Where the files of a pretrained model are: a folder, the hub's cache, or the hub; and what to do when they are nowhere.

A model is looked for as a folder, then in the cache of the hub, and only then on the hub, so a run without network, or
with ``HF_HUB_OFFLINE=1``, needs nothing but the files. Looking takes seconds; only :func:`locate` with ``download`` fetches.
"""

import gc
import importlib
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple, Optional

from ..errors import UserError
from ..hub import TIMEOUT, files_below

Picks = Callable[[Collection[str]], list[str]]
"""From the names of all files of a model to those that are needed; raises UserError when one is missing."""


class WeightFile(NamedTuple):
    """One file of weights, and how ``from_pretrained`` is told to take this one."""

    name: str
    """Path below the model's folder."""

    @property
    def options(self) -> dict:
        return {
            "variant": "fp16" if ".fp16." in self.name else None,
            "use_safetensors": self.name.endswith(".safetensors"),
            "local_files_only": True,
        }


def require_extra(extra: str, *modules: str) -> None:
    """Raise UserError, which says what to install, unless all ``modules`` can be imported."""
    for module in modules:
        try:
            importlib.import_module(module)
        except ImportError as error:
            raise UserError(f"this prior needs {module} ({error}): run `pip install threestudio-gaussiandreamer[{extra}]`") from error


def locate(model: str, picks: Picks, *, option: str, revision: Optional[str] = None, download: bool = True) -> Optional[Path]:
    """The folder that holds the files which ``picks`` names; None when they are on the hub and ``download`` is off.

    Args:
        model: a folder, or a model id of the hub ("openai/shap-e").
        option: the name of the option that ``model`` came from, for messages.

    Raises:
        UserError: files are missing, or the model is nowhere, gated or out of reach; the message says what to do.
    """
    folder = Path(model).expanduser()
    if folder.is_dir():
        picks(files_below(folder))
        return folder
    require_extra("diffusion", "huggingface_hub")
    cached = cached_snapshot(model, revision, option)
    if cached is not None and _is_complete(cached, picks):
        return cached
    names = picks(hub_files(model, revision, option))
    return download_files(model, revision, names, option) if download else None


def pick_weights(files: Collection[str], prefix: str, stem: str, *, allow_bin: bool, model: str) -> WeightFile:
    """The weights of one part: full precision before half, safetensors before a pickle.

    Args:
        prefix: the part's folder with a slash ("prior/"), or "" for a model of one part.
        stem: "diffusion_pytorch_model" (diffusers) or "model" (transformers).
        allow_bin: take a ``.bin`` where there is nothing else. It is a pickle, read with ``weights_only``: it can't run code.

    Raises:
        UserError: there is no file that may be taken.
    """
    binary = f"{prefix}{'pytorch_model' if stem == 'model' else stem}.bin"
    candidates = [f"{prefix}{stem}.safetensors", f"{prefix}{stem}.fp16.safetensors", *([binary] if allow_bin else [])]
    for name in candidates:
        if name in files:
            return WeightFile(name)
    if binary in files:
        raise UserError(
            f"{model!r} has {binary} but no {candidates[0]}: name a model or a revision with safetensors, or set allow_bin: true,"
            " which reads the .bin with PyTorch's weights_only loader"
        )
    raise UserError(f"{model!r} has no {' or '.join(candidates)}: its files are not complete, or it is another kind of model")


def require_files(files: Collection[str], names: Collection[str], model: str) -> list[str]:
    """``names``, when all are among ``files``; else a UserError."""
    missing = [name for name in names if name not in files]
    if missing:
        raise UserError(f"{model!r} has no {', '.join(missing)}: its files are not complete, or it is another kind of model")
    return list(names)


def tokenizer_files(files: Collection[str], prefix: str, model: str) -> list[str]:
    """All files of the CLIP tokenizer, which is either one JSON or a vocabulary and its merges."""
    if f"{prefix}tokenizer.json" not in files:
        require_files(files, [f"{prefix}vocab.json", f"{prefix}merges.txt"], model)
    names = ("tokenizer.json", "tokenizer_config.json", "special_tokens_map.json", "vocab.json", "merges.txt")
    return [prefix + name for name in names if prefix + name in files]


def load_weights(kind: type, folder: Path, weights: WeightFile, subfolder: str = "") -> Any:
    """A network of diffusers or transformers, float32, in evaluation mode, on the CPU.

    Raises:
        UserError: the files are damaged, or lack a weight; which those libraries would fill with noise after a warning.
    """
    what = f"{kind.__name__} in {str(folder / subfolder)!r}"
    with reading(what), _quiet_transformers():
        model, report = kind.from_pretrained(folder, subfolder=subfolder, output_loading_info=True, **weights.options)
    missing = sorted(report["missing_keys"])
    if missing:
        raise UserError(f"{what} has no weights for {', '.join(missing[:4])}{f' and {len(missing) - 4} more' if missing[4:] else ''}")
    return model.float().eval()


@contextmanager
def reading(what: str) -> Iterator[None]:
    """Turn what a library raises about a damaged or foreign file into one UserError that names it."""
    try:
        yield
    except UserError:
        raise
    except Exception as error:  # every library and format has its own
        raise UserError(f"{what} can't be read: {type(error).__name__}: {str(error).strip()[:500]}") from error


def free_memory() -> None:
    """Give back what models held that nothing refers to any more, also on the GPU."""
    import torch

    gc.collect()
    if torch.cuda.is_available():
        torch.cuda.empty_cache()


@contextmanager
def _quiet_transformers() -> Iterator[None]:
    """Without its table of the weights that a file has and the wanted part doesn't, as a whole CLIP's for its text half."""
    from transformers.utils import logging

    level = logging.get_verbosity()
    logging.set_verbosity_error()
    try:
        yield
    finally:
        logging.set_verbosity(level)


# ------------------------------------------------------------------------------------------------------------- the hub


def cached_snapshot(model: str, revision: Optional[str], option: str) -> Optional[Path]:
    """The folder of ``model`` in the hub's cache, complete or not; None when there is none."""
    from huggingface_hub import snapshot_download
    from huggingface_hub.errors import HFValidationError

    try:  # a pattern that fits nothing: what is complete is decided by the files that are needed, not by the hub's list
        return Path(snapshot_download(model, revision=revision, local_files_only=True, allow_patterns=["-"]))
    except HFValidationError as error:
        raise UserError(f"{option}: there is no folder {model!r}, and it is no model id of the hub either (owner/name)") from error
    except OSError:
        return None


def hub_files(model: str, revision: Optional[str], option: str) -> set[str]:
    """Names of the files that the hub has for ``model``; takes seconds also when it fails."""
    from huggingface_hub import HfApi

    try:
        info = HfApi().model_info(model, revision=revision, timeout=TIMEOUT)
    except Exception as error:  # the HTTP library that the hub uses, and so its errors, changed more than once
        raise unreachable(model, revision, option, error) from error
    return {sibling.rfilename for sibling in info.siblings or ()}


def download_files(model: str, revision: Optional[str], names: list[str], option: str) -> Path:
    """Fetch ``names`` into the hub's cache."""
    from huggingface_hub import snapshot_download

    try:
        return Path(snapshot_download(model, revision=revision, allow_patterns=names))
    except Exception as error:
        raise unreachable(model, revision, option, error) from error


def unreachable(model: str, revision: Optional[str], option: str, error: Exception) -> UserError:
    """What the hub's refusal means for the user, and what to do."""
    from huggingface_hub.errors import GatedRepoError, RepositoryNotFoundError, RevisionNotFoundError

    page = f"https://huggingface.co/{model}"
    command = f"hf download {model}" + (f" --revision {revision}" if revision else "")
    if isinstance(error, GatedRepoError):
        return UserError(f"{option}: {model!r} is gated: accept its terms at {page}, run `hf auth login`, then `{command}`")
    if isinstance(error, RepositoryNotFoundError):
        return UserError(
            f"{option}: {model!r} is neither a folder nor a public model of the hub: check the name; a private model needs `hf auth login`"
        )
    if isinstance(error, RevisionNotFoundError):
        return UserError(f"{option}: {model!r} has no revision {revision!r}: see {page}")
    reason = (str(error).strip() or type(error).__name__).splitlines()[0][:200]
    return UserError(
        f"{option}: {model!r} is not on this machine and the hub can't be reached ({reason}): run `{command}` where there is a network,"
        f" or set {option} to a folder that holds the model. To run without any weights: --config demo.yaml"
    )


def _is_complete(folder: Path, picks: Picks) -> bool:
    """Whether the cache has all; what is missing may be fetched, so here it is no error."""
    try:
        picks(files_below(folder))
    except UserError:
        return False
    return True
