"""The configuration of a run: YAML files, then ``key=value`` overrides, merged, resolved and typed.

Sections, key names, resolvers and the output tree are threestudio's. Two things differ: loading
makes no folder, and what is text stays text. ``system.prompt_processor.prompt=1984`` and
``prompt=${x}`` on the command line mean these very characters, and the folder that is named after a
prompt never leaves the output root."""

import hashlib
import os
import re
import unicodedata
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, fields
from datetime import datetime
from glob import escape as glob_escape
from itertools import combinations
from pathlib import Path
from typing import Any, Optional

import yaml
from omegaconf import MISSING, DictConfig, ListConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from ..core.checkpoint_file import newest_readable
from ..core.errors import UserError
from ..core.files import atomic_file
from ..core.interpolation import escape
from ..core.schedule import C_max
from ..host import find, info, names
from ..host.builtin.base import fill
from ..prompts.prompts import read_prompt

# keys whose value is the user's own words, never YAML
TOP_LEVEL_TEXT = ("name", "tag", "description")
PROMPT_TEXT = (
    "prompt",
    "negative_prompt",
    "prompt_front",
    "prompt_side",
    "prompt_back",
    "prompt_overhead",
)
# a path may hold what YAML reads as a comment or a mapping; only null and interpolations are still
# special
PATH_ENDINGS = ("path", "mesh", "_file", "_dir", "resume", "weights")
# stands for "${" of a text while interpolations are resolved; a character of Unicode's private use
# area
PROTECTED = "$\ue000{"
MOST_DEPTH = 32
MOST_NODES = 10_000
SLUG_BYTES = 64
SLUG_CHARACTERS = "-_.,+=()'! "
WINDOWS_DEVICES = {
    "con",
    "prn",
    "aux",
    "nul",
    *(f"{port}{i}" for port in ("com", "lpt") for i in range(1, 10)),
}


@dataclass
class ExperimentConfig:
    """What a YAML file may hold at its top level; the second block is computed, and accepted from a
    ``parsed.yaml``.
    """

    name: str = "default"
    description: str = ""
    tag: str = ""
    seed: int = 0
    use_timestamp: bool = True
    timestamp: Optional[str] = None
    exp_root_dir: str = "outputs"
    resume: Optional[str] = None

    exp_dir: str = ""
    trial_name: str = ""
    trial_dir: str = ""
    n_gpus: int = 1

    data_type: str = ""
    data: dict = field(default_factory=dict)
    system_type: str = ""
    system: dict = field(default_factory=dict)
    # arguments of Lightning's Trainer and ModelCheckpoint
    trainer: dict = field(default_factory=dict)
    checkpoint: dict = field(default_factory=dict)


def load_config(*paths: str | os.PathLike, cli_args: Sequence[str] = (), n_gpus: int = 1) -> Any:
    """The run that these YAML files (later ones win) and ``key=value`` overrides describe; makes no
    folder.

    Returns:
        an :class:`ExperimentConfig` as a DictConfig without interpolations.

    Raises:
        UserError: a file can't be read, an override isn't ``key=value``, a top-level key is
            unknown, a ``???`` or an interpolation is left open, a value has the wrong type.
    """
    sources = [
        _with_prompt_from_file(source)
        for source in [*map(read_yaml, paths), parse_overrides(cli_args)]
    ]
    merged = _merge(sources)
    merged.n_gpus = n_gpus
    _require_mandatory(merged)
    _resolve(merged)
    cfg = fill(ExperimentConfig, merged)
    _name_folders(cfg)
    return cfg


def dump_config(path: str | os.PathLike, cfg: Any) -> None:
    """Write a configuration so that :func:`load_config` reads the same run back; what it was
    resumed from is left out.
    """
    plain = OmegaConf.create(OmegaConf.to_container(cfg, resolve=False))
    if "resume" in plain:
        plain.resume = None
    with atomic_file(path) as file:
        file.write(OmegaConf.to_yaml(plain).encode())


def read_yaml(path: str | os.PathLike) -> DictConfig:
    """One YAML file as a mapping; prompts that look like numbers or booleans (``prompt: 1984``) are
    still text.

    Raises:
        UserError: the file is missing, isn't UTF-8, isn't YAML, or isn't a mapping; with line and
            column.
    """
    try:
        source = Path(path).read_text(encoding="utf-8-sig")
        require_modest(source, f"the configuration {path}")
        content, node = OmegaConf.create(source), yaml.compose(source, Loader=yaml.SafeLoader)
    except (OSError, UnicodeDecodeError) as error:
        raise UserError(f"the configuration {path} can't be read: {error}") from error
    except (yaml.YAMLError, OmegaConfBaseException) as error:
        raise UserError(
            f"the configuration {path} isn't valid YAML: {_yaml_problem(error)}"
        ) from error
    if not isinstance(content, DictConfig):
        raise UserError(
            f"the configuration {path} must hold sections and keys, such as 'name: demo'"
        )
    _require_words(content, f"the configuration {path}")
    _restore_text(content, node)
    _map_strings(content, _protect_escaped)
    return content


def parse_overrides(arguments: Iterable[str]) -> DictConfig:
    """``key.of.section=value`` arguments as a mapping. Values are YAML, except text and paths,
    which are taken as they are.

    Raises:
        UserError: an argument that isn't ``key=value``, or whose value isn't YAML.
    """
    overrides = OmegaConf.create({})
    for argument in arguments:
        key, equals, value = argument.partition("=")
        if not equals or not key or not (key[0].isalpha() or key[0] == "_"):
            raise UserError(
                f"{argument!r} isn't an override: expected key=value, such as "
                "trainer.max_steps=1200"
            )
        try:
            _override(overrides, key, _valid_text(key, value))
        except (yaml.YAMLError, OmegaConfBaseException) as error:
            raise UserError(
                f"the value of {key} isn't valid YAML: {_yaml_problem(error)}"
            ) from error
    _require_words(overrides, "the command line")
    return overrides


def safe_name(text: str) -> str:
    """``text`` as one folder name: itself if it is harmless, else a slug of at most 64 bytes and a
    hash of the text.

    Harmless means letters, digits and ``-_.,+=()'!`` or inner spaces, no leading dot or hyphen, and
    no device of Windows."""
    slug = "".join(
        c if c.isalnum() or c in SLUG_CHARACTERS else "_"
        for c in unicodedata.normalize("NFC", text)
    )
    slug = slug.encode()[:SLUG_BYTES].decode(errors="ignore").lstrip("-. ").rstrip(". ")
    if slug and slug == text and slug.split(".")[0].lower() not in WINDOWS_DEVICES:
        return slug
    return f"{slug or 'run'}-{hashlib.sha256(text.encode()).hexdigest()[:8]}"


def is_text(key: str) -> bool:
    """Whether the value of this dotted key is the user's own words."""
    section, _, leaf = key.rpartition(".")
    return key in TOP_LEVEL_TEXT or (section.endswith("prompt_processor") and leaf in PROMPT_TEXT)


def _override(overrides: DictConfig, key: str, value: str) -> None:
    if is_text(key):
        OmegaConf.update(overrides, key, protect(value), force_add=True)
    elif key.endswith(PATH_ENDINGS):
        OmegaConf.update(
            overrides, key, None if value in ("", "null", "~") else value, force_add=True
        )
    else:
        require_modest(value, f"the value of {key}")
        overrides.merge_with_dotlist([f"{key}={value}"])


def _valid_text(key: str, value: str) -> str:
    """The value of a key, which is to be written into ``parsed.yaml``; Python takes other bytes
    than UTF-8 for lone surrogates.
    """
    try:
        (key + value).encode()
    except UnicodeEncodeError as error:
        raise UserError(f"{key!r} or its value isn't valid UTF-8 text: {error}") from error
    if key.count(".") >= MOST_DEPTH:
        raise UserError(f"{key[:80]!r}... is no key: sections lie at most {MOST_DEPTH} deep")
    return value


def require_modest(source: str, what: str) -> None:
    """Raise UserError where YAML is nested so deeply, or by aliases of aliases stands for so much,
    that reading it ends in a crash.

    The parser's events come one by one, so nothing is built to find out; libyaml's own recursion
    would end the process."""
    for depth, values in _extent(source):
        if depth > MOST_DEPTH or values >= MOST_NODES:
            raise UserError(
                f"{what} must be at most {MOST_DEPTH} levels deep and hold fewer than "
                f"{MOST_NODES} values"
            )


def _extent(source: str) -> Iterator[tuple[int, int]]:
    """At each event of the parser: how deep it is, also in interpolations, and for how many values
    the innermost section stands so far.
    """
    sections: list[tuple[Optional[str], int]] = [(None, 0)]
    anchored: dict[Optional[str], int] = {}
    for event in yaml.parse(source, Loader=yaml.SafeLoader):
        if isinstance(event, yaml.CollectionStartEvent):
            sections.append((event.anchor, 1))
        elif isinstance(event, (yaml.CollectionEndEvent, yaml.ScalarEvent, yaml.AliasEvent)):
            anchor, count = (
                sections.pop() if isinstance(event, yaml.CollectionEndEvent) else (event.anchor, 1)
            )
            if isinstance(event, yaml.AliasEvent):
                count = anchored.get(anchor, MOST_NODES)  # of itself, which never ends
            anchored[anchor] = count
            sections[-1] = (sections[-1][0], sections[-1][1] + count)
        yield max(len(sections), getattr(event, "value", "").count("${")), sections[-1][1]


def _require_words(content: DictConfig | ListConfig, what: str) -> None:
    """Raise UserError for a key that isn't a text, such as ``on``, which is ``true`` in YAML."""
    if content._is_none() or content._is_missing() or content._is_interpolation():
        return
    for key in content if isinstance(content, DictConfig) else range(len(content)):
        if isinstance(content, DictConfig) and not isinstance(key, str):
            raise UserError(
                f"{what} has the key {key!r}, which isn't a word: put it in quotes if it is "
                "meant so"
            )
        child = content._get_node(key)
        if isinstance(child, (DictConfig, ListConfig)):
            _require_words(child, what)


def _yaml_problem(error: Exception) -> str:
    mark = getattr(error, "problem_mark", None)
    place = f"line {mark.line + 1}, column {mark.column + 1}: " if mark else ""
    return place + (getattr(error, "problem", None) or str(error).splitlines()[0])


def _restore_text(content: DictConfig, node: Any, section: str = "") -> None:
    """Give text keys that YAML read as a number or boolean their words back; ``node`` is the file
    as written.
    """
    if not isinstance(node, yaml.MappingNode):
        return
    for key_node, value_node in node.value:
        if key_node.value not in content:  # an anchor's merge, or a key that isn't a word
            continue
        key = f"{section}{key_node.value}"
        if isinstance(value_node, yaml.MappingNode):
            _restore_text(content[key_node.value], value_node, f"{key}.")
        elif is_text(key) and isinstance(
            content._get_node(key_node.value)._value(), (bool, int, float)
        ):
            content[key_node.value] = value_node.value


def _with_prompt_from_file(source: DictConfig) -> DictConfig:
    """``prompt_processor.prompt_file`` replaced by a ``prompt`` that is the file's text, so that
    the tag can be made of it.
    """
    section = OmegaConf.select(source, "system.prompt_processor")
    if not isinstance(section, DictConfig) or section.get("prompt_file") is None:
        return source
    if "prompt" in section:
        raise UserError("system.prompt_processor has both prompt and prompt_file: give one of them")
    text = read_prompt(section.pop("prompt_file"))
    OmegaConf.update(source, "system.prompt_processor.prompt", protect(text), force_add=True)
    return source


def _merge(sources: list[DictConfig]) -> DictConfig:
    try:
        merged = OmegaConf.create({})
        for source in sources:
            _forget_replaced_parts(merged, source)
            merged = OmegaConf.merge(merged, source)
    except OmegaConfBaseException as error:
        raise UserError(f"the configurations can't be merged: {_explain(error)}") from error
    except TypeError as error:
        clash = next(filter(None, (_clash(a, b) for a, b in combinations(sources, 2))), "a key")
        raise UserError(
            f"the configurations can't be merged: {clash} is a list in one and a section in another"
        ) from error
    for section in ("data", "system", "trainer", "checkpoint"):
        # "trainer:" with nothing below it is null in YAML
        if section in merged and merged._get_node(section)._is_none():
            merged[section] = {}
    return merged


def _forget_replaced_parts(earlier: DictConfig, later: DictConfig, path: str = "") -> None:
    """Where ``later`` names another part (``x_type``), drop the options of ``earlier``'s ``x`` that
    the new part doesn't have.

    So ``system.geometry.prior_type=random-prior`` is all that it takes to try another prior; what
    ``later`` itself gives stays. What ``later`` leaves open (``???``) has to be given anew, even if
    ``earlier`` has a value (OmegaConf would keep that)."""
    for key in later:
        if OmegaConf.is_missing(later, key):
            earlier._content.pop(key, None)
            continue
        section = key.removesuffix("_type")
        mine, theirs = earlier._get_node(key), later._get_node(key)
        if isinstance(mine, DictConfig) and isinstance(theirs, DictConfig):
            _forget_replaced_parts(mine, theirs, f"{path}{key}.")
        elif section != key and mine is not None and mine._value() != theirs._value():
            _keep_options_of(earlier._get_node(section), theirs._value(), f"{path}{section}")


def _keep_options_of(section: Any, type_name: Any, path: str) -> None:
    config_class = getattr(find(type_name), "Config", None) if type_name in names() else None
    if config_class is None or not isinstance(section, DictConfig):
        return
    known = {field.name for field in fields(config_class)}
    foreign = [key for key in section if key not in known]
    for key in foreign:
        section._content.pop(key)
    if foreign:
        info(f"{path}: {type_name} has no {', '.join(foreign)}; left out")


def _clash(a: DictConfig, b: DictConfig, section: str = "") -> Optional[str]:
    """The first key that is a list in one and a section in the other."""
    for key in a:
        one, other = a._get_node(key), b._get_node(key) if key in b else None
        if isinstance(one, (DictConfig, ListConfig)) and isinstance(
            other, (DictConfig, ListConfig)
        ):
            if type(one) is not type(other):
                return f"{section}{key}"
            found = _clash(one, other, f"{section}{key}.") if isinstance(one, DictConfig) else None
            if found:
                return found
    return None


def _require_mandatory(cfg: DictConfig) -> None:
    missing = sorted(_missing_keys(cfg))
    if missing:
        example = "a corgi" if is_text(missing[0]) else "..."
        raise UserError(
            f"no value for {', '.join(missing)}: set it in the YAML or as {missing[0]}={example!r}"
        )


def _missing_keys(node: DictConfig, section: str = "") -> list[str]:
    # OmegaConf.missing_keys resolves interpolations on its way, which fails when one leads to a
    # "???"
    if node._is_none() or node._is_interpolation():
        return []
    children = {f"{section}{key}": node._get_node(key) for key in node}
    missing = [key for key, child in children.items() if child._is_missing()]
    inner = {
        key: child
        for key, child in children.items()
        if isinstance(child, DictConfig) and key not in missing
    }
    return missing + [
        found for key, child in inner.items() for found in _missing_keys(child, f"{key}.")
    ]


def _resolve(cfg: DictConfig) -> None:
    register_resolvers()
    try:
        OmegaConf.resolve(cfg)
    except OmegaConfBaseException as error:
        raise UserError(f"an interpolation can't be resolved: {_explain(error)}") from error
    except (TypeError, ValueError, ArithmeticError, AttributeError) as error:
        raise UserError(f"a resolver failed: {error}") from error
    except RecursionError as error:
        raise UserError("an interpolation leads to itself") from error
    _map_strings(cfg, _unprotect)


def protect(text: str) -> str:
    """``text`` as a value that resolving leaves alone, also where another value refers to it;
    :func:`_unprotect` ends it.

    Raises:
        UserError: it is ``???``, which means in every configuration that a value is missing.
    """
    if text == MISSING:
        raise UserError(
            f"{MISSING!r} can't be a text: in configurations it means that a value is missing; "
            "add a word"
        )
    return text.replace("${", PROTECTED)


def _protect_escaped(text: str) -> str:
    """A string of a YAML whose every ``${`` is escaped holds no interpolation: it is text, as in a
    ``parsed.yaml``.
    """
    if "${" not in text or re.search(r"(?<!\\)(\\\\)*\$\{", text):
        return text
    return re.sub(r"(\\+)\$\{", lambda match: "\\" * (len(match[1]) // 2) + PROTECTED, text)


def _unprotect(text: str) -> str:
    # after resolving, a "${" that is left is somebody's text
    return escape(text.replace(PROTECTED, "${"))


def _map_strings(node: DictConfig | ListConfig, change: Callable[[str], str]) -> None:
    """Replace every stored string below ``node``, interpolations unresolved, by ``change`` of it."""
    if node._is_none() or node._is_missing() or node._is_interpolation():
        return
    for key in node if isinstance(node, DictConfig) else range(len(node)):
        child = node._get_node(key)
        if isinstance(child, (DictConfig, ListConfig)):
            _map_strings(child, change)
        elif isinstance(child._value(), str):
            child._set_value(change(child._value()))


def _explain(error: OmegaConfBaseException) -> str:
    message = str(error).splitlines()[0]
    return f"{error.full_key}: {message}" if error.full_key else message


def register_resolvers() -> None:
    """The functions that a YAML may call as ``${name:...}``; those that threestudio has registered
    stay.
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
        "tuple2": lambda value: [float(value), float(value)],
        "gt0": lambda value: value > 0,
        "cmaxgt0": lambda value: C_max(value) > 0,
        "not": lambda value: not value,
        "cmaxgt0orcmaxgt0": lambda a, b: C_max(a) > 0 or C_max(b) > 0,
    }
    # omegaconf 2.4 renamed it
    enter = getattr(OmegaConf, "register_resolver", OmegaConf.register_new_resolver)
    for name, function in resolvers.items():
        if not OmegaConf.has_resolver(name):
            enter(name, function)


def _name_folders(cfg: Any) -> None:
    """``exp_root_dir/name/tag@time``; a run that is resumed from its ``parsed.yaml`` keeps its
    time, and so its folder.
    """
    if not cfg.tag and not cfg.use_timestamp:
        raise UserError("a run needs a tag when use_timestamp is false: both name its folder")
    if "\0" in cfg.exp_root_dir:
        raise UserError(f"exp_root_dir is {cfg.exp_root_dir!r}; no folder's name has a NUL")
    tag = safe_name(cfg.tag) if cfg.tag else ""
    cfg.exp_dir = escape(os.path.join(cfg.exp_root_dir, safe_name(cfg.name)))
    if cfg.timestamp is None:
        cfg.timestamp = (
            _new_timestamp(os.path.join(cfg.exp_dir, tag))
            if cfg.use_timestamp and cfg.n_gpus == 1
            else ""
        )
    _set_trial(cfg, tag + cfg.timestamp)
    if cfg.resume == "auto":
        _resume_newest(cfg, tag)


def _set_trial(cfg: Any, trial_name: str) -> None:
    cfg.trial_name = trial_name
    cfg.trial_dir = escape(os.path.join(cfg.exp_dir, trial_name))


def _new_timestamp(prefix: str) -> str:
    timestamp = datetime.now().strftime("@%Y%m%d-%H%M%S")
    # two runs of one prompt that start within the same second
    count = 1
    while os.path.exists(prefix + timestamp + (f"-{count}" if count > 1 else "")):
        count += 1
    return timestamp + (f"-{count}" if count > 1 else "")


def _resume_newest(cfg: Any, tag: str) -> None:
    """``resume=auto``: go on with this run if it was started before, else with the newest of its
    tag, else start.

    In its folder it is the readable checkpoint with most steps: where the last one is damaged, the
      one before it.
    """
    cfg.resume = None
    newest_first = sorted(Path(cfg.exp_dir).glob(f"{glob_escape(tag)}@*"), reverse=True)
    for run in [Path(cfg.trial_dir), *newest_first]:
        found = newest_readable(run / "ckpts")
        if found:
            cfg.timestamp = run.name.removeprefix(tag)
            _set_trial(cfg, run.name)
            path, step = found
            cfg.resume = escape(str(path))
            info(f"resume=auto: going on from {path} (step {step})")
            return
    info(
        f"resume=auto: no checkpoint of {os.path.join(cfg.exp_dir, tag)} to go on from; "
        "starting anew"
    )
