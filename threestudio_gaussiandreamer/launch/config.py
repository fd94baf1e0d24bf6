"""The configuration of a run: YAML files, then ``key=value`` overrides, merged, resolved and typed.

Sections, key names, resolvers and the output tree are threestudio's. Two things differ: loading
makes no folder, and what is text stays text (see ``config_source.py``). The sources are read by
``config_source.py``; the folder is named by ``run_folder.py``."""

import functools
import os
from collections.abc import Sequence
from dataclasses import dataclass, field, fields
from itertools import combinations
from pathlib import Path
from typing import Any, Optional

import omegaconf
from omegaconf import DictConfig, ListConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from ..core.errors import UserError
from ..core.files import atomic_file
from ..core.schedule import C_max
from ..host import find, info, names
from ..host.typed_config import parse_structured
from ..prompts.prompts import read_prompt
from ..training.losses import foreign_weights
from ..training.optimizer import foreign_arguments
from .config_source import is_text, map_strings, parse_overrides, protect, read_yaml, unprotect
from .ddp import planned_processes
from .run_folder import name_folders


@dataclass
class ExperimentConfig:
    """The keys at the top level of a YAML file. Those from ``exp_dir`` to ``n_gpus`` are computed;
    they are accepted because a ``parsed.yaml`` has them.
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
    sources = [
        _with_prompt_from_file(source)
        for source in [*map(read_yaml, paths), parse_overrides(cli_args)]
    ]
    if given := [name for name in COMPUTED if name in sources[-1]]:
        raise UserError(
            f"{given[0]} is computed: set exp_root_dir, name and tag for the folder of a run, and "
            "--gpu or trainer.devices for the GPUs"
        )
    merged = _merge(sources)
    _name_own_object(merged, sources)
    trainer = {name: _trainer_option(merged, name) for name in ("devices", "num_nodes")}
    merged.n_gpus = planned_processes(n_gpus, trainer).total
    _require_mandatory(merged)
    _resolve(merged)
    _zero_null_weights(merged.get("system"))
    cfg = parse_structured(ExperimentConfig, merged)
    name_folders(cfg, paths)
    return cfg


def _trainer_option(merged: DictConfig, name: str) -> Any:
    """Return an option before all are resolved; None if it can't be, which is reported later."""
    try:
        return OmegaConf.select(merged, f"trainer.{name}")
    except OmegaConfBaseException:
        return None


def dump_config(path: str | os.PathLike, cfg: Any) -> None:
    """Write a configuration from which :func:`load_config` restores the same run, without
    ``resume`` and ``new_folder``.
    """
    plain = OmegaConf.create(OmegaConf.to_container(cfg, resolve=False))
    if "resume" in plain:
        plain.resume = None
    plain.pop("new_folder", None)
    if not plain.get("viewer"):
        plain.pop("viewer", None)  # threestudio doesn't know the key
    with atomic_file(path) as file:
        file.write(OmegaConf.to_yaml(plain).encode())


def _with_prompt_from_file(source: DictConfig) -> DictConfig:
    """Replace ``prompt_processor.prompt_file`` by a ``prompt`` with the file's text, so that the
    tag can refer to it.
    """
    try:
        section = OmegaConf.select(source, "system.prompt_processor")
    except OmegaConfBaseException:  # system is a list, or leads to another section
        return source
    if not isinstance(section, DictConfig) or section.get("prompt_file") is None:
        return source
    if "prompt" in section:
        raise UserError("system.prompt_processor has both prompt and prompt_file: give one of them")
    text = read_prompt(section.pop("prompt_file"))
    OmegaConf.update(source, "system.prompt_processor.prompt", protect(text), force_add=True)
    return source


def _name_own_object(merged: DictConfig, sources: list[DictConfig]) -> None:
    """Let a prompt that no model reads be the name of the mesh or cloud that a later file or the
    command line gives, instead of what the earlier file says of its own object.
    """
    system = merged.get("system")
    if not system or system.get("prompt_processor_type") != "plain-prompt-processor":
        return
    place, keys = "system.prompt_processor.prompt", ("guidance.mesh", "geometry.prior.path")
    for source in reversed(sources):
        if _own_text(source, place) is not None:
            return
        if path := next(filter(None, (_own_text(source, f"system.{key}") for key in keys)), None):
            OmegaConf.update(merged, place, protect(Path(path).stem), force_add=True)
            return


def _own_text(source: DictConfig, key: str) -> Optional[str]:
    """Return the text at a dotted key; None for a missing value and one that refers to another."""
    node: Any = source
    for name in key.split("."):
        node = node._get_node(name) if isinstance(node, DictConfig) and name in node else None
    known = node is not None and not node._is_interpolation() and not node._is_missing()
    return node._value() if known and isinstance(node._value(), str) else None


def _merge(sources: list[DictConfig]) -> DictConfig:
    *files, overrides = sources
    try:
        merged = functools.reduce(_overlaid, files, OmegaConf.create({}))
        _require_values(merged, overrides)
        merged = _overlaid(merged, overrides)
    except (OmegaConfBaseException, TypeError) as error:
        clash = next(filter(None, (_clash(a, b) for a, b in combinations(sources, 2))), None)
        reason = f"{clash} is a list in one and a section in another" if clash else _explain(error)
        raise UserError(f"the configurations can't be merged: {reason}") from error
    for section in ("data", "system", "trainer", "checkpoint", "viewer"):
        # YAML reads "trainer:" without content as null
        if section in merged and merged._get_node(section)._is_none():
            merged[section] = {}
        _require_section(merged, section)
    return merged


def _overlaid(earlier: DictConfig, later: DictConfig) -> DictConfig:
    _forget_replaced_parts(earlier, later)
    return OmegaConf.merge(earlier, later)


def _require_values(merged: DictConfig, overrides: DictConfig, path: str = "") -> None:
    """Check that no override empties the section of a part or of the launcher, as ``trainer=``."""
    for key in overrides:
        section, override = merged._get_node(key), overrides._get_node(key)
        if not isinstance(section, DictConfig) or not len(section):
            continue
        if isinstance(override, DictConfig):
            _require_values(section, override, f"{path}{key}.")
        elif override._value() is None and (not path or f"{key}_type" in merged):
            raise UserError(
                f"{path}{key} is empty, which would remove its {len(section)} keys: set one of "
                f"them, such as {path}{key}.{next(iter(section))}=<value>"
            )


def _require_section(merged: DictConfig, name: str) -> None:
    node = merged._get_node(name)
    if node is None or isinstance(node, DictConfig):
        return
    if node._is_interpolation() or node._is_missing():  # reported later
        return
    raise UserError(
        f"{name} must be a section of keys and values, got {node._value()!r}: set a key, such "
        f"as {name}.<key>=<value>"
    )


def _forget_replaced_parts(earlier: DictConfig, later: DictConfig, path: str = "") -> None:
    """Remove options from ``earlier`` that are invalid after a merge with ``later``, in place.

    If ``later`` changes a part (``x_type``), the options in ``earlier``'s section ``x`` that the
    new part doesn't have are removed, so that ``system.geometry.prior_type=random-prior`` suffices
    to select another prior; so are the arguments that a new optimiser doesn't take. If ``later``
    has a mandatory value (``???``), ``earlier``'s value is removed too, which OmegaConf's merge
    would keep."""
    for key in later:
        if OmegaConf.is_missing(later, key):
            earlier._content.pop(key, None)
            continue
        section = key.removesuffix("_type")
        mine, theirs = earlier._get_node(key), later._get_node(key)
        if isinstance(mine, DictConfig) and isinstance(theirs, DictConfig):
            _forget_replaced_parts(mine, theirs, f"{path}{key}.")
            continue
        if mine is None or mine._value() == theirs._value():
            continue
        if f"{path}{key}" == "system.optimizer.name":
            _keep_arguments_of(earlier._get_node("args"), theirs._value())
        if section != key:
            _keep_options_of(earlier._get_node(section), theirs._value(), f"{path}{section}")
            if f"{path}{section}" == "system.guidance":
                _keep_weights_of(earlier._get_node("loss"), theirs._value())


def _keep_options_of(section: Any, type_name: Any, path: str) -> None:
    config_class = getattr(find(type_name), "Config", None) if type_name in names() else None
    if config_class is None or not isinstance(section, DictConfig):
        return
    known = {field.name for field in fields(config_class)}
    _leave_out([key for key in section if key not in known], section, type_name, path)


def _keep_arguments_of(arguments: Any, optimizer: Any) -> None:
    if isinstance(arguments, DictConfig):
        foreign = foreign_arguments(optimizer, arguments)
        _leave_out(foreign, arguments, optimizer, "system.optimizer.args")


def _keep_weights_of(loss: Any, guidance: Any) -> None:
    """Remove the weights of losses that belong to the replaced guidance."""
    if guidance in names() and isinstance(loss, DictConfig):
        _leave_out(foreign_weights(loss, find(guidance)), loss, guidance, "system.loss")


def _leave_out(foreign: list[str], section: DictConfig, type_name: str, path: str) -> None:
    for key in foreign:
        section._content.pop(key)
    if foreign:
        info(f"{path}: {type_name} has no {', '.join(foreign)}; left out")


def _zero_null_weights(system: Any) -> None:
    """Replace null among the weights of losses by 0, which parts of the system can compute with."""
    loss = system.get("loss") if isinstance(system, DictConfig) else None
    for key in loss if isinstance(loss, DictConfig) else ():
        if loss[key] is None:
            loss[key] = 0


def _clash(a: DictConfig, b: DictConfig, section: str = "") -> Optional[str]:
    """Return the first key that is a list in one of the two and a section in the other."""
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
    # not OmegaConf.missing_keys, which resolves interpolations and fails if one refers to "???"
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
        OmegaConf.to_container(cfg, resolve=True)  # unlike omegaconf 2.3's resolve, names the key
        OmegaConf.resolve(cfg)
    except OmegaConfBaseException as error:
        raise UserError(f"an interpolation can't be resolved: {_explain(error)}") from error
    except (TypeError, ValueError, ArithmeticError, AttributeError) as error:
        raise UserError(f"a resolver failed: {error}") from error
    except RecursionError as error:
        raise UserError("an interpolation leads to itself") from error
    map_strings(cfg, unprotect)


def _explain(error: Exception) -> str:
    message, key = str(error).splitlines()[0], getattr(error, "full_key", None)
    return f"{key}: {message}" if key else message


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
