"""The configuration of a run: YAML files, then ``key=value`` overrides, merged and resolved as
threestudio does; but no folder is made, and prompts, names and paths on the command line are read
verbatim. What the options mean is checked in ``config_check.py``."""

import contextlib
import itertools
import os
import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any, Optional

import omegaconf
import yaml
from omegaconf import MISSING, DictConfig, ListConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from ..core.errors import UserError
from ..core.files import write_file
from ..core.options import escape, in_range, parse_structured, require_mapping
from ..core.schedule import parse_schedule
from ..host import find, info, names
from ..prompts.prompts import read_prompt
from ..training.losses import foreign_weights
from ..training.optimizer import foreign_arguments
from .ddp import planned_processes
from .run_folder import name_folders, value_at

TEXTS = re.compile(
    r"name|tag|description|"
    r".*prompt_processor\.(prompt|negative_prompt|prompt_(front|side|back|overhead))"
)
"""Keys whose values are texts, never YAML."""
PATH_ENDINGS = ("path", "mesh", "_file", "_dir", "resume", "weights")
"""Keys whose values are paths: only null and interpolations have a meaning."""
NO_TEXT = re.compile(r"^\?\?\?$|(?<!\\)(\\\\)*\$\{")
"""A missing value, or the beginning of an interpolation, unless it is escaped."""
MOST_DEPTH = 32
MOST_NODES = 10_000
SECTIONS = ("data", "system", "trainer", "checkpoint", "viewer")


@dataclass
class ExperimentConfig:
    """The keys at the top level of a YAML file; those of :data:`COMPUTED` of a ``parsed.yaml``."""

    name: str = "default"
    description: str = ""
    tag: str = ""
    seed: int = field(default=0, metadata=in_range(0, 2**32 - 1))
    use_timestamp: bool = True
    timestamp: Optional[str] = None
    exp_root_dir: str = "outputs"
    resume: Optional[str] = None

    exp_dir: str = ""
    trial_name: str = ""
    trial_dir: str = ""
    new_folder: bool = False
    n_gpus: int = 1

    data_type: str = ""
    data: dict = field(default_factory=dict)
    system_type: str = ""
    system: dict = field(default_factory=dict)
    # arguments of Lightning's Trainer and ModelCheckpoint
    trainer: dict = field(default_factory=dict)
    checkpoint: dict = field(default_factory=dict)
    viewer: dict = field(default_factory=dict)


COMPUTED = ("exp_dir", "trial_name", "trial_dir", "new_folder", "n_gpus")


def load_config(*paths: str | os.PathLike, cli_args: Sequence[str] = (), n_gpus: int = 0) -> Any:
    """Merge YAML files, of which later ones take precedence, and ``key=value`` overrides into an
    :class:`ExperimentConfig`, a DictConfig without interpolations. ``n_gpus`` are visible.

    Raises:
        UserError: a file can't be read, an override isn't ``key=value``, a top-level key is
            unknown, a ``???`` or an interpolation is left open, or a value has the wrong type.
    """
    sources = [*map(read_yaml, paths), parse_overrides(cli_args)]
    if given := [name for name in COMPUTED if name in sources[-1]]:
        instead = "set exp_root_dir, name and tag, or --gpu"
        raise UserError(f"{given[0]} is computed: {instead}")
    merged: dict[str, Any] = {}
    for source in sources:
        _read_prompt_file(source)
        merged = _overlaid(merged, source, final=source is sources[-1])
    merged = _overlaid(merged, _own_object(merged, sources))
    for name in SECTIONS:
        if merged.get(name) is None:  # as YAML reads "trainer:" without content
            merged[name] = {}
        elif not isinstance(merged[name], str):
            require_mapping(name, merged[name])
    if missing := sorted(_missing_keys(merged)):
        raise UserError(f"no value for {', '.join(missing)}: set it as {missing[0]}='...'")
    resolved = _resolved(merged, n_gpus)
    loss = value_at(resolved, "system.loss")
    if isinstance(loss, dict):  # null is no loss, too
        loss |= {name: 0 for name, weight in loss.items() if weight is None}
    cfg = OmegaConf.structured(parse_structured(ExperimentConfig, escape(resolved)))
    name_folders(cfg, paths)
    return cfg


def dump_config(path: str | os.PathLike, cfg: Any) -> None:
    """Write a configuration from which :func:`load_config` restores the same run."""
    plain = OmegaConf.to_container(cfg, resolve=False) | {"resume": None}
    plain.pop("new_folder", None)
    if not plain.get("viewer"):
        plain.pop("viewer", None)  # threestudio doesn't know the key
    write_file(path, OmegaConf.to_yaml(OmegaConf.create(plain)))


# -- files and overrides ---------------------------------------------------------------------------


def read_yaml(path: str | os.PathLike) -> dict[str, Any]:
    """Read a YAML file as a mapping, in which interpolations and ``???`` are still text, as are
    prompts that look like numbers or booleans (``prompt: 1984``); raise UserError if it is missing,
    isn't UTF-8, isn't valid YAML or isn't a mapping.
    """
    what = f"the configuration {path}"
    with _yaml_errors(what):
        source = read_source(path).decode("utf-8-sig")
        node = _bounded(what, source)
        values = OmegaConf.create(source)
    if not isinstance(values, DictConfig):
        raise UserError(f"{what} must hold sections and keys, such as 'name: demo'")
    values = OmegaConf.to_container(values)
    _restore_texts(values, node)
    return values


def read_source(path: str | os.PathLike) -> bytes:
    """Read a configuration file; raise UserError if it can't be read."""
    try:
        return Path(path).read_bytes()
    except OSError as error:
        raise UserError(f"the configuration {path} can't be read: {error}") from error


def parse_overrides(arguments: Iterable[str]) -> dict[str, Any]:
    """Parse ``section.key=value`` arguments into a mapping; values are YAML, except texts and
    paths. Raise UserError if an argument isn't ``key=value``, or its value isn't valid YAML.
    """
    overrides = OmegaConf.create({})
    for argument in arguments:
        key, equals, value = argument.partition("=")
        if not equals or not re.match(r"[^\W\d]", key):
            expected = "expected key=value, such as trainer.max_steps=1200"
            raise UserError(f"{argument!r} isn't an override: {expected}")
        if key == "resume" and not value.strip():
            # of an unset variable in a script; to start over would set the run's checkpoints aside
            raise UserError("resume= has no value: write resume=auto, a file, or resume=null")
        with _yaml_errors(f"the value of {key}"):
            argument.encode()  # undecodable bytes are lone surrogates
            if TEXTS.fullmatch(key):
                OmegaConf.update(overrides, key, verbatim(value), force_add=True)
            elif key.endswith(PATH_ENDINGS):
                path = None if value in ("", "null", "~") else value
                OmegaConf.update(overrides, key, path, force_add=True)
            else:
                _bounded(f"the value of {key}", value)
                overrides.merge_with_dotlist([argument])
    with _yaml_errors("the command line"):
        return OmegaConf.to_container(overrides)


@contextlib.contextmanager
def _yaml_errors(what: str) -> Iterator[None]:
    """Convert what YAML's and OmegaConf's parsers raise in this context to a UserError."""
    try:
        yield
    except UserError:
        raise
    except (yaml.YAMLError, OmegaConfBaseException, ValueError, RecursionError) as error:
        mark = getattr(error, "problem_mark", None)
        place = f"line {mark.line + 1}, column {mark.column + 1}: " if mark else ""
        problem = getattr(error, "problem", None) or str(error).splitlines()[0]
        kind = "UTF-8" if isinstance(error, UnicodeError) else "valid YAML"
        raise UserError(f"{what} isn't {kind}: {place}{problem}") from error


def _bounded(what: str, source: str) -> Any:
    """Return the YAML node of a source, read by the parser in Python, since deep recursion in
    libyaml ends the process; raise UserError if it is too deeply nested, expands through aliases to
    too many values, or has a key that isn't a string, such as ``on``, which is ``true`` in YAML.
    """

    def nodes(node: Any, depth: int = 0) -> Iterator[Any]:
        if depth > MOST_DEPTH:
            raise RecursionError
        yield node
        inner = () if isinstance(node, yaml.ScalarNode) else node.value
        if isinstance(node, yaml.MappingNode):
            inner = itertools.chain(*inner)
            for key, _ in node.value:
                text = key.value if isinstance(key, yaml.ScalarNode) else f"a {key.id}"
                is_float = re.fullmatch(r"[-+]?[\d.]+[eE][-+]?\d+", text) and not key.style
                if key.tag.rpartition(":")[2] not in ("str", "merge") or is_float:
                    raise UserError(f"{what} has a key that isn't a word, {text}: quote it")
        for item in inner:
            yield from nodes(item, depth + 1)

    try:
        node = yaml.compose(source, Loader=yaml.SafeLoader)
        if node is None or sum(1 for _ in itertools.islice(nodes(node), MOST_NODES)) < MOST_NODES:
            return node
    except RecursionError:
        pass
    raise UserError(
        f"{what} must be at most {MOST_DEPTH} levels deep and hold fewer than {MOST_NODES} values"
    )


def _restore_texts(values: dict[str, Any], node: Any, section: str = "") -> None:
    """Replace values of text keys that YAML has converted by the characters in the file."""
    for key_node, value_node in node.value if isinstance(node, yaml.MappingNode) else ():
        name, key = key_node.value, f"{section}{key_node.value}"
        if isinstance(values.get(name), dict):
            _restore_texts(values[name], value_node, f"{key}.")
        elif isinstance(values.get(name), (bool, int, float)) and TEXTS.fullmatch(key):
            values[name] = value_node.value


def verbatim(text: str) -> str:
    """Return the value for which OmegaConf gives this text, also where another value refers to it;
    raise UserError for ``???``, its marker of a missing value.
    """
    if text == MISSING:
        raise UserError(f"{MISSING!r} can't be a text: it means that a value is missing")
    return escape(text)


# -- overlays --------------------------------------------------------------------------------------


def _overlaid(
    earlier: dict[str, Any], later: dict[str, Any], path: str = "", final: bool = False
) -> dict[str, Any]:
    """Return ``earlier`` with the values of ``later`` in the place of its own, at a ``path`` with a
    final dot. If ``later`` changes a part (``x_type``), options in ``earlier``'s section ``x`` that
    the new one doesn't have are left out. The ``final`` one can't empty a section of a part.
    """
    earlier = dict(earlier)
    for key, new in later.items():
        if key in earlier and new not in (earlier[key], MISSING):
            _leave_out_foreign(earlier, f"{path}{key}", new)
    merged = earlier | later
    for key, new in later.items():
        old, place = earlier.get(key), f"{path}{key}"
        is_reference = isinstance(old, str) and "${" in old and isinstance(new, dict)
        if is_reference or {type(old), type(new)} == {dict, list}:
            kind = "a reference" if is_reference else "a list"
            raise UserError(
                f"configurations can't be merged: {place} is {kind} in one and a section in another"
            )
        if isinstance(old, dict) and isinstance(new, dict):
            merged[key] = _overlaid(old, new, f"{place}.", final)
        elif final and new is None and isinstance(old, dict) and old:
            if not path or f"{key}_type" in earlier:
                raise UserError(f"{place} is empty, which would remove its {len(old)} keys")
    return merged


def _leave_out_foreign(values: dict[str, Any], path: str, name: Any) -> None:
    """Remove what the part or optimiser ``name``, chosen at ``path``, has no use for."""
    section = path.rpartition(".")[2].removesuffix("_type")
    part = find(name) if path.endswith("_type") and name in names() else None
    foreign: dict[str, list[str]] = {}
    if hasattr(part, "Config") and isinstance(values.get(section), dict):
        known = {option.name for option in fields(part.Config)}
        foreign[section] = [key for key in values[section] if key not in known]
    if path == "system.guidance_type" and part and isinstance(values.get("loss"), dict):
        foreign["loss"] = foreign_weights(values["loss"], part)
    if path == "system.optimizer.name" and isinstance(values.get("args"), dict):
        foreign["args"] = foreign_arguments(name, values["args"])
    for section, keys in foreign.items():
        values[section] = {key: v for key, v in values[section].items() if key not in keys}
        if keys:
            place = f"{path.rpartition('.')[0]}.{section}".lstrip(".")
            info(f"{place}: {name} has no {', '.join(keys)}; left out")


def _read_prompt_file(source: dict[str, Any]) -> None:
    """Replace ``prompt_processor.prompt_file`` by a ``prompt``, to which the tag can refer."""
    section = value_at(source, "system.prompt_processor")
    if isinstance(section, dict) and section.get("prompt_file") is not None:
        if "prompt" in section:
            raise UserError("system.prompt_processor has both prompt and prompt_file: give one")
        section["prompt"] = verbatim(read_prompt(section.pop("prompt_file")))


def _own_object(merged: dict[str, Any], sources: list[dict[str, Any]]) -> dict[str, Any]:
    """Return what names a prompt that no model reads by the mesh or cloud given after it."""
    keys = ("prompt_processor.prompt", "guidance.mesh", "geometry.prior.path")
    is_read = value_at(merged, "system.prompt_processor_type") != "plain-prompt-processor"
    for source in [] if is_read else reversed(sources):
        found = [value_at(source, f"system.{key}") for key in keys]
        prompt, *files = [
            text if isinstance(text, str) and not NO_TEXT.search(text) else None for text in found
        ]
        if prompt is not None:
            break
        if path := next(filter(None, files), None):
            return {"system": {"prompt_processor": {"prompt": verbatim(Path(path).stem)}}}
    return {}


def _missing_keys(values: dict[str, Any], section: str = "") -> Iterator[str]:
    # not OmegaConf.missing_keys, which resolves interpolations and fails if one refers to "???"
    for key, value in values.items():
        if value == MISSING:
            yield f"{section}{key}"
        elif isinstance(value, dict):
            yield from _missing_keys(value, f"{section}{key}.")


# -- interpolations --------------------------------------------------------------------------------


def _resolved(merged: dict[str, Any], n_gpus: int) -> dict[str, Any]:
    """Return the values without interpolations, which may refer to the number of processes."""
    register_resolvers()
    try:
        cfg = OmegaConf.create(merged)
        trainer = cfg.get("trainer")
        trainer = trainer if isinstance(trainer, DictConfig) else {}
        cfg.n_gpus = planned_processes(n_gpus, trainer).total
        return OmegaConf.to_container(cfg, resolve=True)
    except (OmegaConfBaseException, RecursionError) as error:
        key, message = getattr(error, "full_key", None), str(error).splitlines()[0]
        raise UserError(
            f"an interpolation can't be resolved: {f'{key}: ' if key else ''}{message}"
        ) from error


def register_resolvers() -> None:
    """Register threestudio's functions that a YAML file may call as ``${name:...}``."""

    def largest(*schedules: Any) -> float:
        return max(max(parse_schedule(value).values) for value in schedules)

    resolvers = {
        "calc_exp_lr_decay_rate": lambda factor, n: factor ** (1.0 / n),
        "add": lambda a, b: a + b,
        "sub": lambda a, b: a - b,
        "mul": lambda a, b: a * b,
        "div": lambda a, b: a / b,
        "idiv": lambda a, b: a // b,
        "basename": os.path.basename,
        "rmspace": lambda text, substitute: str(text).replace(" ", substitute),
        "tuple2": lambda value: ListConfig([float(value), float(value)]),  # 2.3: no list
        "gt0": lambda value: value > 0,
        "cmaxgt0": lambda value: largest(value) > 0,
        "not": lambda value: not value,
        "cmaxgt0orcmaxgt0": lambda a, b: largest(a, b) > 0,
    }
    # 2.4 gave this function the name that another one had before
    is_old = [int(part) for part in omegaconf.__version__.split(".")[:2]] < [2, 4]
    enter = OmegaConf.register_new_resolver if is_old else OmegaConf.register_resolver
    for name, function in resolvers.items():
        if not OmegaConf.has_resolver(name):
            enter(name, function)
