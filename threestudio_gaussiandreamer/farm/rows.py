"""Read prompt lists: one prompt per line, or CSV or JSONL with the columns of docs/farm.md; as a
stream, since a list may have a million rows."""

import csv
import hashlib
import json
import shlex
import unicodedata
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple, Optional

from ..core.errors import UserError, unknown
from ..core.files import existing_file
from ..launch.config import verbatim
from ..launch.run_folder import safe_name

COLUMNS = ("prompt", "name", "seed", "config", "overrides")
MOST_LINE_BYTES = 32_768
MOST_SEED = 2**32 - 1


class Row(NamedTuple):
    """One asset that is asked for."""

    name: str
    prompt: str
    seed: Optional[int] = None
    config: tuple[str, ...] = ()
    overrides: tuple[str, ...] = ()
    line: int = 0
    """Where it stands in its file, from 1."""

    @property
    def key(self) -> str:
        """A digest of what the asset depends on beside the farm's configuration."""
        content = [self.prompt, self.seed, self.config, self.overrides]
        return hashlib.sha256(json.dumps(content).encode()).hexdigest()[:16]


def read_rows(path: Path) -> Iterator[Row]:
    """Yield the rows of a prompt list; raises UserError, whose message names the line."""
    existing_file(path, "prompt list")
    suffix = path.suffix.lower()
    if suffix not in FORMATS:
        raise unknown(f"format of the prompt list {str(path)!r}:", suffix, filter(None, FORMATS))
    number = 0

    def texts() -> Iterator[str]:
        nonlocal number
        with open(path, "rb") as file:
            while content := file.readline(MOST_LINE_BYTES + 1):
                number += 1
                text = _decoded(content, "utf-8-sig" if number == 1 else "utf-8")
                if text.strip() and not text.lstrip().startswith("#"):
                    yield text

    try:
        for values in FORMATS[suffix](texts()):
            yield make_row(values, number)
    except (UserError, csv.Error) as error:
        raise UserError(f"{path}, line {number}: {error}") from error


def check_rows(path: Path) -> int:
    """Return the number of rows; raises UserError also for none, and for two of one name."""
    lines: dict[bytes, int] = {}
    for row in read_rows(path):
        # a digest, since a set of a million names takes less memory so
        digest = hashlib.blake2b(row.name.casefold().encode(), digest_size=8).digest()
        earlier = lines.setdefault(digest, row.line)
        if earlier != row.line:
            said = f"{path}: lines {earlier} and {row.line} have the same name {row.name!r} (upper "
            said += "and lower case are one folder on some machines); remove one, or give names in "
            raise UserError(f"{said}a CSV or JSONL list (columns prompt, name, seed)")
    if not lines:
        raise UserError(f"{path} has no prompts: expected one per line, such as 'a fox'")
    return len(lines)


def make_row(values: Mapping[str, Any], line: int = 0) -> Row:
    """Check the values of one row, and fill in its name."""
    for column in values:
        if column not in COLUMNS:
            raise unknown("column", column, COLUMNS)
    prompt, seed, name = (values.get(column) for column in ("prompt", "seed", "name"))
    if not isinstance(prompt, str) or not prompt.strip():
        raise UserError(f"the prompt is {prompt!r}; expected a text, such as 'a fox'")
    if any(unicodedata.category(character) in ("Cc", "Cs", "Zl", "Zp") for character in prompt):
        raise UserError(f"the prompt {prompt[:80]!r} has a line break or a control character")
    verbatim(prompt := prompt.strip())  # refuses "???", which means that a value is missing
    if seed in (None, ""):
        seed = None
    else:
        text = "" if isinstance(seed, bool) else str(seed)
        if not (text.isascii() and text.isdigit() and len(text) <= 10 and int(text) <= MOST_SEED):
            raise UserError(f"the seed is {seed!r}; expected a whole number from 0 to {MOST_SEED}")
        seed = int(text)
    if name in (None, ""):
        words = "_".join(prompt.split())
        name = safe_name(words if seed is None else f"{words}-seed{seed}")
    elif not isinstance(name, str) or safe_name(name) != name:
        instead = f"expected for instance {safe_name(str(name))!r}"
        raise UserError(f"the name {str(name)[:80]!r} can't be a folder's: {instead}")
    config, overrides = _texts("config", values.get("config")), _overrides(values.get("overrides"))
    return Row(name, prompt, seed, tuple(config), tuple(overrides), line)


def _texts(column: str, value: Any) -> list[str]:
    values = [value] if isinstance(value, str) else value or []
    if not isinstance(values, list) or not all(isinstance(text, str) for text in values):
        raise UserError(f"{column} is {value!r}; expected a text or a list of texts")
    return [text for text in values if text]


def _overrides(value: Any) -> list[str]:
    if isinstance(value, Mapping):
        # JSON is YAML, but a text stands without its quotes, as on a command line
        value = [f"{k}={v if isinstance(v, str) else json.dumps(v)}" for k, v in value.items()]
    if isinstance(value, str):
        try:
            value = shlex.split(value)
        except ValueError as error:
            raise UserError(f"the overrides {value[:80]!r} have an open quote: {error}") from error
    texts = _texts("overrides", value)
    for text in texts:
        if "=" not in text:
            raise UserError(f"the override {text!r} isn't key=value, such as trainer.max_steps=600")
    return texts


def _decoded(content: bytes, encoding: str) -> str:
    text = content.decode(encoding, errors="replace")
    if len(content) > MOST_LINE_BYTES or {"\0", "\ufffd"} & {*text}:
        raise UserError(
            f"longer than {MOST_LINE_BYTES} bytes, or no UTF-8 text; expected a list of prompts "
            "(.txt, .csv, .jsonl), which Excel saves as CSV UTF-8"
        )
    return text


def _from_text(texts: Iterator[str]) -> Iterator[dict[str, Any]]:
    return ({"prompt": text.strip()} for text in texts)


def _from_csv(texts: Iterator[str]) -> Iterator[dict[str, Any]]:
    reader = csv.DictReader(texts, skipinitialspace=True, strict=True)
    reader.fieldnames = header = [column.strip() for column in reader.fieldnames or []]
    if header and "prompt" not in header or len(set(header)) != len(header):
        for column in header:
            if column not in COLUMNS and not {";", "\t"} & {*column}:
                raise unknown("column", column, COLUMNS)
        raise UserError(
            "the first line must name each column once, separated by commas, with a column "
            f"prompt; it is {','.join(header)!r}"
        )
    for values in reader:
        if None in values:
            count = f"{len(header) + len(values[None])} cells for {len(header)} columns"
            raise UserError(f"{count}; put a text with commas in double quotes")
        yield values


def _from_jsonl(texts: Iterator[str]) -> Iterator[dict[str, Any]]:
    for text in texts:
        try:
            values = json.loads(text, object_pairs_hook=_named_once)
        except (ValueError, RecursionError) as error:
            raise UserError(f"can't be read as JSON: {error}") from error
        if not isinstance(values, dict):
            raise UserError('expected an object {"prompt": "a fox"}')
        yield values


def _named_once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    names = [name for name, _ in pairs]
    if len(set(names)) < len(names):
        raise ValueError(f"{max(names, key=names.count)!r} is given twice")
    return dict(pairs)


FORMATS: dict[str, Callable[[Iterator[str]], Iterator[dict[str, Any]]]] = {
    **{".csv": _from_csv, ".jsonl": _from_jsonl, ".ndjson": _from_jsonl},
    **{".txt": _from_text, "": _from_text},
}
