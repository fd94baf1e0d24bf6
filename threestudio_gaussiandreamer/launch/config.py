"""The configuration of a run: YAML files, then ``key=value`` overrides, merged and resolved.

Sections, key names, resolvers and the output tree are threestudio's. Two things differ: loading
makes no folder, and texts are read verbatim: on the command line
``system.prompt_processor.prompt=1984`` is the text "1984", and ``prompt=${x}`` isn't an
interpolation. What the options mean is checked in ``config_check.py``."""

import contextlib
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
from ..core.files import atomic_file
from ..core.options import escape, parse_structured, require_mapping, satisfies
from ..core.schedule import C_max
from ..host import find, info, names
from ..prompts.prompts import read_prompt
from ..training.losses import foreign_weights
from ..training.optimizer import foreign_arguments
from .ddp import planned_processes
from .run_folder import name_folders

TEXTS = re.compile(
    r"name|tag|description|"
    r".*prompt_processor\.(prompt|negative_prompt|prompt_(front|side|back|overhead))"
)
"""Keys whose values are texts, never YAML."""
PATH_ENDINGS = ("path", "mesh", "_file", "_dir", "resume", "weights")
"""Keys whose values are paths, which may contain "#" or ": "; only null and interpolations have a
meaning."""
REFERENCE = re.compile(r"(?<!\\)(\\\\)*\$\{")
"""Begins an interpolation, unless it is escaped."""
MOST_DEPTH = 32
MOST_NODES = 10_000
MOST_BYTES = 1 << 20
SECTIONS = ("data", "system", "trainer", "checkpoint", "viewer")


@dataclass
class ExperimentConfig:
    """The keys at the top level of a YAML file. Those from ``exp_dir`` to ``n_gpus`` are computed;
    they are accepted because a ``parsed.yaml`` has them.
    """

    name: str = "default"
    description: str = ""
    tag: str = ""
    seed: int = field(
        default=0,
        metadata=satisfies("a whole number from 0 to 2^32 - 1", lambda seed: 0 <= seed < 2**32),
    )
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
    """See ``live_viewer.py``."""


COMPUTED = ("exp_dir", "trial_name", "trial_dir", "new_folder", "n_gpus")
"""Keys that only a ``parsed.yaml`` may have."""


def load_config(*paths: str | os.PathLike, cli_args: Sequence[str] = (), n_gpus: int = 0) -> Any:
    """Merge YAML files, of which later ones take precedence, and ``key=value`` overrides into the
    configuration of a run. No folder is created.

    Args:
        n_gpus: visible GPUs; 0 for the CPU.

    Returns:
        an :class:`ExperimentConfig` as a DictConfig without interpolations.

    Raises:
        UserError: a file can't be read, an override isn't ``key=value``, a top-level key is
            unknown, a ``???`` or an interpolation is left open, a value has the wrong type; see
            also :func:`planned_processes`.
    """
    sources = [*map(read_yaml, paths), parse_overrides(cli_args)]
    if given := [name for name in COMPUTED if name in sources[-1]]:
        raise UserError(
            f"{given[0]} is computed: set exp_root_dir, name and tag for the folder of a run, and "
            "--gpu or trainer.devices for the GPUs"
        )
    merged: dict[str, Any] = {}
    for source in sources:
        _read_prompt_file(source)
        merged = _overlaid(merged, source, final=source is sources[-1])
    merged = _overlaid(merged, _own_object(merged, sources))
    for name in SECTIONS:
        if merged.get(name) is None:  # as YAML reads "trainer:" without content
            merged[name] = {}
        if not isinstance(merged[name], str) or _is_plain_text(merged[name]):
            require_mapping(name, merged[name])
    if missing := sorted(_missing_keys(merged)):
        example = "a corgi" if TEXTS.fullmatch(missing[0]) else "..."
        raise UserError(
            f"no value for {', '.join(missing)}: set it in the YAML or as {missing[0]}={example!r}"
        )
    resolved = _resolved(merged, n_gpus)
    loss = _value_at(resolved, "system.loss")
    if isinstance(loss, dict):  # null is no loss, too
        loss |= {name: 0 for name, weight in loss.items() if weight is None}
    cfg = OmegaConf.structured(parse_structured(ExperimentConfig, escape(resolved)))
    name_folders(cfg, paths)
    return cfg


def dump_config(path: str | os.PathLike, cfg: Any) -> None:
    """Write a configuration from which :func:`load_config` restores the same run, without
    ``resume`` and ``new_folder``.
    """
    plain = OmegaConf.to_container(cfg, resolve=False) | {"resume": None}
    plain.pop("new_folder", None)
    if not plain.get("viewer"):
        plain.pop("viewer", None)  # threestudio doesn't know the key
    with atomic_file(path) as file:
        file.write(OmegaConf.to_yaml(OmegaConf.create(plain)).encode())


# -- files and overrides ---------------------------------------------------------------------------


def read_yaml(path: str | os.PathLike) -> dict[str, Any]:
    """Read a YAML file as a mapping, in which interpolations and ``???`` are still text. Prompts
    that look like numbers or booleans (``prompt: 1984``) are text.

    Raises:
        UserError: the file is missing, isn't UTF-8, isn't valid YAML (with line and column), or
            isn't a mapping.
    """
    what = f"the configuration {path}"
    try:
        with open(path, "rb") as file:
            content = file.read(MOST_BYTES + 1)
        source = content.decode("utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise UserError(f"{what} can't be read: {error}") from error
    if len(content) > MOST_BYTES:
        raise UserError(f"{what} is larger than {MOST_BYTES >> 20} MiB")
    with _yaml_errors(what):
        node = _bounded(what, source)
        values = OmegaConf.create(source)
    if not isinstance(values, DictConfig):
        raise UserError(f"{what} must hold sections and keys, such as 'name: demo'")
    values = OmegaConf.to_container(values)
    _require_words(values, what)
    _restore_texts(values, node)
    return values


def parse_overrides(arguments: Iterable[str]) -> dict[str, Any]:
    """Parse ``section.key=value`` arguments into a mapping. Values are YAML, except texts and
    paths, which are read verbatim.

    Raises:
        UserError: an argument isn't ``key=value``, or its value isn't valid YAML.
    """
    overrides = OmegaConf.create({})
    for argument in arguments:
        key, equals, value = argument.partition("=")
        if not equals or not re.match(r"[^\W\d]", key):
            raise UserError(
                f"{argument!r} isn't an override: expected key=value, such as "
                "trainer.max_steps=1200"
            )
        try:
            argument.encode()  # undecodable bytes are lone surrogates
        except UnicodeEncodeError as error:
            raise UserError(f"{key!r} or its value isn't valid UTF-8 text: {error}") from error
        if key.count(".") >= MOST_DEPTH:
            raise UserError(f"{key[:80]!r}... is no key: sections lie at most {MOST_DEPTH} deep")
        if key == "resume" and not value.strip():
            # of an unset variable in a script; to start over would set the run's checkpoints aside
            raise UserError("resume= has no value: write resume=auto, a file, or resume=null")
        with _yaml_errors(f"the value of {key}"):
            if TEXTS.fullmatch(key):
                OmegaConf.update(overrides, key, verbatim(value), force_add=True)
            elif key.endswith(PATH_ENDINGS):
                path = None if value in ("", "null", "~") else value
                OmegaConf.update(overrides, key, path, force_add=True)
            else:
                _bounded(f"the value of {key}", value)
                overrides.merge_with_dotlist([argument])
    values = OmegaConf.to_container(overrides)
    _require_words(values, "the command line")
    return values


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
        raise UserError(f"{what} isn't valid YAML: {place}{problem}") from error


def _bounded(what: str, source: str) -> Any:
    """Return the YAML node of a source, from which no value is constructed.

    The pure Python parser is used, since deep recursion in libyaml ends the process.

    Raises:
        UserError: it is so deeply nested, or expands through aliases to so many values, that
            constructing it would crash.
    """
    sizes: dict[int, int] = {}

    def size(node: Any, depth: int) -> int:
        nested = node.value.count("${") if isinstance(node, yaml.ScalarNode) else depth
        if nested > MOST_DEPTH:
            raise RecursionError
        if id(node) not in sizes:
            sizes[id(node)] = MOST_NODES  # of an alias inside of the section that it names
            inner = [] if isinstance(node, yaml.ScalarNode) else node.value
            if isinstance(node, yaml.MappingNode):
                inner = [item for pair in inner for item in pair]
            sizes[id(node)] = 1 + sum(size(item, depth + 1) for item in inner)
        return sizes[id(node)]

    try:
        node = yaml.compose(source, Loader=yaml.SafeLoader)
        if node is None or size(node, 0) < MOST_NODES:
            return node
    except RecursionError:
        pass
    raise UserError(
        f"{what} must be at most {MOST_DEPTH} levels deep and hold fewer than {MOST_NODES} values"
    )


def _restore_texts(values: dict[str, Any], node: Any, section: str = "") -> None:
    """Replace values of text keys that YAML has converted to numbers or booleans by the characters
    in the file, which the unconverted ``node`` has.
    """
    for key_node, value_node in node.value if isinstance(node, yaml.MappingNode) else ():
        name, key = key_node.value, f"{section}{key_node.value}"
        if isinstance(values.get(name), dict):
            _restore_texts(values[name], value_node, f"{key}.")
        elif isinstance(values.get(name), (bool, int, float)) and TEXTS.fullmatch(key):
            values[name] = value_node.value


def verbatim(text: str) -> str:
    """Return the value with which OmegaConf gives this text, also where another value refers to it.

    Raises:
        UserError: the text is ``???``, OmegaConf's marker of a missing value.
    """
    if text == MISSING:
        raise UserError(
            f"{MISSING!r} can't be a text: in configurations it means that a value is missing; "
            "add a word"
        )
    return escape(text)


def _require_words(value: Any, what: str) -> None:
    """Raise UserError for a key that isn't a string, such as ``on``, which is ``true`` in YAML."""
    for key, child in value.items() if isinstance(value, dict) else enumerate(value):
        if isinstance(value, dict) and not isinstance(key, str):
            raise UserError(
                f"{what} has the key {key!r}, which isn't a word: put it in quotes if it is meant "
                "so"
            )
        if isinstance(child, (dict, list)):
            _require_words(child, what)


# -- overlays --------------------------------------------------------------------------------------


def _overlaid(
    earlier: dict[str, Any], later: dict[str, Any], path: str = "", final: bool = False
) -> dict[str, Any]:
    """Return ``earlier`` with the values of ``later`` in the place of its own.

    If ``later`` changes a part (``x_type``), the options in ``earlier``'s section ``x`` that the
    new part doesn't have are left out, so that ``system.geometry.prior_type=random-prior`` suffices
    to select another prior; so are the arguments that a new optimiser doesn't take, and the weights
    of losses that another guidance doesn't return.

    Args:
        path: of the section, with a final dot.
        final: ``later`` is the command line, which can't empty a section of a part.
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
                f"the configurations can't be merged: {place} is {kind} in one and a section in "
                "another"
            )
        if isinstance(old, dict) and isinstance(new, dict):
            merged[key] = _overlaid(old, new, f"{place}.", final)
        elif final and old and isinstance(old, dict) and new is None:
            if not path or f"{key}_type" in earlier:
                raise UserError(
                    f"{place} is empty, which would remove its {len(old)} keys: set one of them, "
                    f"such as {place}.{next(iter(old))}=<value>"
                )
    return merged


def _leave_out_foreign(values: dict[str, Any], path: str, name: Any) -> None:
    """Remove the options that belong to the part or optimiser before ``name``, which the key
    ``path`` selects, from the sections beside it.
    """
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
    """Replace ``prompt_processor.prompt_file`` by a ``prompt`` with the file's text, so that the
    tag can refer to it.
    """
    section = _value_at(source, "system.prompt_processor")
    if isinstance(section, dict) and section.get("prompt_file") is not None:
        if "prompt" in section:
            raise UserError(
                "system.prompt_processor has both prompt and prompt_file: give one of them"
            )
        section["prompt"] = verbatim(read_prompt(section.pop("prompt_file")))


def _own_object(merged: dict[str, Any], sources: list[dict[str, Any]]) -> dict[str, Any]:
    """Return what names a prompt that no model reads by the mesh or cloud that a later file or the
    command line gives, instead of what the earlier file says of its own object.
    """
    keys = ("prompt_processor.prompt", "guidance.mesh", "geometry.prior.path")
    is_read = _value_at(merged, "system.prompt_processor_type") != "plain-prompt-processor"
    for source in [] if is_read else reversed(sources):
        found = [_value_at(source, f"system.{key}") for key in keys]
        prompt, *files = [text if _is_plain_text(text) else None for text in found]
        if prompt is not None:
            break
        if path := next(filter(None, files), None):
            return {"system": {"prompt_processor": {"prompt": verbatim(Path(path).stem)}}}
    return {}


def _value_at(source: Any, key: str) -> Any:
    """Return the value at a dotted key; None if there is none."""
    for name in key.split("."):
        source = source.get(name) if isinstance(source, dict) else None
    return source


def _is_plain_text(value: Any) -> bool:
    """Return whether a value is a text that is neither missing nor refers to another value."""
    return isinstance(value, str) and value != MISSING and not REFERENCE.search(value)


def _missing_keys(values: dict[str, Any], section: str = "") -> Iterator[str]:
    # not OmegaConf.missing_keys, which resolves interpolations and fails if one refers to "???"
    for key, value in values.items():
        if value == MISSING:
            yield f"{section}{key}"
        elif isinstance(value, dict):
            yield from _missing_keys(value, f"{section}{key}.")


# -- interpolations --------------------------------------------------------------------------------


def _resolved(merged: dict[str, Any], n_gpus: int) -> dict[str, Any]:
    """Return the values without interpolations, and with the number of processes, to which they may
    refer.
    """
    register_resolvers()
    try:
        cfg = OmegaConf.create(merged)
        trainer = cfg.get("trainer")
        cfg.n_gpus = planned_processes(
            n_gpus, trainer if isinstance(trainer, DictConfig) else {}
        ).total
        return OmegaConf.to_container(cfg, resolve=True)
    except OmegaConfBaseException as error:
        key, message = getattr(error, "full_key", None), str(error).splitlines()[0]
        raise UserError(
            f"an interpolation can't be resolved: {f'{key}: ' if key else ''}{message}"
        ) from error
    except RecursionError as error:
        raise UserError("an interpolation leads to itself") from error
    except UserError:
        raise
    except (TypeError, ValueError, ArithmeticError, AttributeError) as error:
        raise UserError(f"a resolver failed: {error}") from error


def register_resolvers() -> None:
    """Register the functions that a YAML file may call as ``${name:...}``. Those that threestudio
    has registered are kept.
    """
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
        "cmaxgt0": lambda value: C_max(value) > 0,
        "not": lambda value: not value,
        "cmaxgt0orcmaxgt0": lambda a, b: C_max(a) > 0 or C_max(b) > 0,
    }
    # omegaconf 2.4 gave the new function the name that the one without nesting had before
    is_old = [int(part) for part in omegaconf.__version__.split(".")[:2]] < [2, 4]
    enter = OmegaConf.register_new_resolver if is_old else OmegaConf.register_resolver
    for name, function in resolvers.items():
        if not OmegaConf.has_resolver(name):
            enter(name, function)
