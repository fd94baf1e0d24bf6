"""Read the sources of a configuration, YAML files and ``key=value`` overrides, as dictionaries in
which interpolations and ``???`` are still text.

Keys for text are read verbatim: on the command line ``system.prompt_processor.prompt=1984`` is the
text "1984", and ``prompt=${x}`` isn't an interpolation."""

import os
import re
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any, Optional

import yaml
from omegaconf import MISSING, DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from ..core.errors import UserError

# keys whose value is text, never YAML
TOP_LEVEL_TEXT = ("name", "tag", "description")
PROMPT_TEXT = (
    "prompt",
    "negative_prompt",
    "prompt_front",
    "prompt_side",
    "prompt_back",
    "prompt_overhead",
)
# Values of these keys are paths. They aren't read as YAML, since a path may contain "#" or ": ";
# only null and interpolations have a meaning.
PATH_ENDINGS = ("path", "mesh", "_file", "_dir", "resume", "weights")
# replaces "${" in texts while interpolations are resolved; U+E000 is for private use
PROTECTED = "$\ue000{"
MOST_DEPTH = 32
MOST_NODES = 10_000
MOST_BYTES = 1 << 20


def read_yaml(path: str | os.PathLike) -> dict[str, Any]:
    """Read a YAML file as a mapping. Prompts that look like numbers or booleans (``prompt: 1984``)
    are text.

    Raises:
        UserError: the file is missing, isn't UTF-8, isn't valid YAML (with line and column), or
            isn't a mapping.
    """
    try:
        source = _read_text(Path(path))
        require_modest(source, f"the configuration {path}")
        content, node = OmegaConf.create(source), yaml.compose(source, Loader=yaml.SafeLoader)
    except UserError:
        raise
    except (OSError, UnicodeDecodeError) as error:
        raise UserError(f"the configuration {path} can't be read: {error}") from error
    except (yaml.YAMLError, OmegaConfBaseException, ValueError) as error:
        raise UserError(
            f"the configuration {path} isn't valid YAML: {_yaml_problem(error)}"
        ) from error
    if not isinstance(content, DictConfig):
        raise UserError(
            f"the configuration {path} must hold sections and keys, such as 'name: demo'"
        )
    values = OmegaConf.to_container(content)
    _require_words(values, f"the configuration {path}")
    _restore_text(values, node)
    return map_strings(values, _protect_escaped)


def _read_text(path: Path) -> str:
    """Read the text of a configuration file.

    Raises:
        UserError: the file has more than ``MOST_BYTES``.
        OSError, UnicodeDecodeError: it can't be read or isn't UTF-8.
    """
    with open(path, "rb") as file:
        content = file.read(MOST_BYTES + 1)
    if len(content) > MOST_BYTES:
        raise UserError(f"the configuration {path} is larger than {MOST_BYTES >> 20} MiB")
    return content.decode("utf-8-sig")


def parse_overrides(arguments: Iterable[str]) -> dict[str, Any]:
    """Parse ``section.key=value`` arguments into a mapping. Values are YAML, except texts and
    paths, which are read verbatim.

    Raises:
        UserError: an argument isn't ``key=value``, or its value isn't valid YAML.
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
        except UserError:
            raise
        except (yaml.YAMLError, OmegaConfBaseException, ValueError) as error:
            raise UserError(
                f"the value of {key} isn't valid YAML: {_yaml_problem(error)}"
            ) from error
    values = OmegaConf.to_container(overrides)
    _require_words(values, "the command line")
    return values


def is_text(key: str) -> bool:
    """Return whether the value of this dotted key is text, which isn't read as YAML."""
    section, _, leaf = key.rpartition(".")
    return key in TOP_LEVEL_TEXT or (section.endswith("prompt_processor") and leaf in PROMPT_TEXT)


def _override(overrides: DictConfig, key: str, value: str) -> None:
    if is_text(key):
        OmegaConf.update(overrides, key, protect(value), force_add=True)
    elif key == "resume" and not value.strip():
        # of an unset variable in a script; to start over would set the run's checkpoints aside
        raise UserError("resume= has no value: write resume=auto, a file, or resume=null")
    elif key.endswith(PATH_ENDINGS):
        OmegaConf.update(
            overrides, key, None if value in ("", "null", "~") else value, force_add=True
        )
    else:
        require_modest(value, f"the value of {key}")
        overrides.merge_with_dotlist([f"{key}={value}"])


def _valid_text(key: str, value: str) -> str:
    """Return ``value`` if ``parsed.yaml`` can hold it.

    Raises:
        UserError: key or value isn't valid UTF-8, which Python decodes to lone surrogates, or the
            key has too many levels.
    """
    try:
        (key + value).encode()
    except UnicodeEncodeError as error:
        raise UserError(f"{key!r} or its value isn't valid UTF-8 text: {error}") from error
    if key.count(".") >= MOST_DEPTH:
        raise UserError(f"{key[:80]!r}... is no key: sections lie at most {MOST_DEPTH} deep")
    return value


def require_modest(source: str, what: str) -> None:
    """Raise UserError for YAML so deeply nested, or expanding through aliases to so many values,
    that constructing it would crash.

    Only the parser's events are counted, and no value is constructed. The pure Python parser is
    used, since deep recursion in libyaml ends the process."""
    for depth, values in _extent(source):
        if depth > MOST_DEPTH or values >= MOST_NODES:
            raise UserError(
                f"{what} must be at most {MOST_DEPTH} levels deep and hold fewer than "
                f"{MOST_NODES} values"
            )


def _extent(source: str) -> Iterator[tuple[int, int]]:
    """Yield at each event of the parser the depth, of sections or of nested interpolations, and
    the number of values in the innermost section so far, with aliases expanded.
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
                count = anchored.get(anchor, MOST_NODES)  # an alias of a section that contains it
            anchored[anchor] = count
            sections[-1] = (sections[-1][0], sections[-1][1] + count)
        yield max(len(sections), getattr(event, "value", "").count("${")), sections[-1][1]


def _require_words(content: Any, what: str) -> None:
    """Raise UserError for a key that isn't a string, such as ``on``, which is ``true`` in YAML."""
    for key, child in content.items() if isinstance(content, dict) else enumerate(content):
        if isinstance(content, dict) and not isinstance(key, str):
            raise UserError(
                f"{what} has the key {key!r}, which isn't a word: put it in quotes if it is "
                "meant so"
            )
        if isinstance(child, (dict, list)):
            _require_words(child, what)


def _yaml_problem(error: Exception) -> str:
    mark = getattr(error, "problem_mark", None)
    place = f"line {mark.line + 1}, column {mark.column + 1}: " if mark else ""
    return place + (getattr(error, "problem", None) or str(error).splitlines()[0])


def _restore_text(content: dict[str, Any], node: Any, section: str = "") -> None:
    """Replace values of text keys that YAML has converted to numbers or booleans by the characters
    in the file.

    Args:
        content: the mapping, changed in place.
        node: the unconverted YAML node of ``content``.
        section: the dotted path of ``content``, with a final dot.
    """
    if not isinstance(node, yaml.MappingNode):
        return
    for key_node, value_node in node.value:
        if key_node.value not in content:  # a merge key ("<<"), or a key that isn't a string
            continue
        key = f"{section}{key_node.value}"
        if isinstance(value_node, yaml.MappingNode):
            _restore_text(content[key_node.value], value_node, f"{key}.")
        elif is_text(key) and isinstance(content[key_node.value], (bool, int, float)):
            content[key_node.value] = value_node.value


def protect(text: str) -> str:
    """Replace ``${`` in a text, so that it isn't resolved as an interpolation, also where another
    value refers to this one. :func:`unprotect` restores it.

    Raises:
        UserError: the text is ``???``, OmegaConf's marker of a missing value.
    """
    return require_no_marker(text).replace("${", PROTECTED)


def require_no_marker(text: str) -> str:
    """Return a text.

    Raises:
        UserError: it is ``???``, OmegaConf's marker of a missing value.
    """
    if text == MISSING:
        raise UserError(
            f"{MISSING!r} can't be a text: in configurations it means that a value is missing; "
            "add a word"
        )
    return text


def _protect_escaped(text: str) -> str:
    """Unescape and protect a YAML string in which every ``${`` is escaped, as in a ``parsed.yaml``;
    return other strings unchanged.
    """
    if "${" not in text or re.search(r"(?<!\\)(\\\\)*\$\{", text):
        return text
    return re.sub(r"(?<!\\)(\\+)\$\{", lambda match: "\\" * (len(match[1]) // 2) + PROTECTED, text)


def unprotect(text: str) -> str:
    return text.replace(PROTECTED, "${")


def map_strings(value: Any, change: Callable[[str], str]) -> Any:
    """Return a copy of dictionaries and lists in which every string is ``change(string)``."""
    if isinstance(value, dict):
        return {key: map_strings(child, change) for key, child in value.items()}
    if isinstance(value, list):
        return [map_strings(child, change) for child in value]
    return change(value) if isinstance(value, str) else value
