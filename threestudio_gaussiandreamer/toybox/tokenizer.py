"""A CLIP tokenizer that has one token for every word of the toybox.

Any other text becomes bytes and pieces of words.
"""

import json
from collections.abc import Sequence
from pathlib import Path

from ..core.files import atomic_file, existing_file, output_folder
from ..prompts.known_words import WORDS_FILE

START, END = "<|startoftext|>", "<|endoftext|>"
WORDS = Path(WORDS_FILE).name
SETTINGS = "tokenizer_config.json"
"""The file that is written last: a folder that has it is complete."""
LENGTH = 32
"""Tokens of a prompt, start and end included; longer ones are cut."""


def write_tokenizer(folder: Path, words: Sequence[str]) -> None:
    """Write the vocabulary, merges and configuration of a CLIPTokenizer into ``folder``, and the
    list of ``words`` that prompts/known_words.py reads.

    Raises:
        UserError: the disk is full, or the folder can't be written.
    """
    output_folder(folder, "the tokenizer")
    merges = word_merges(words)
    letters = byte_letters()
    tokens = [
        *letters,
        *(f"{letter}</w>" for letter in letters),
        *("".join(pair) for pair in merges),
        START,
        END,
    ]
    _write_json(folder / "vocab.json", {token: index for index, token in enumerate(tokens)})
    lines = ["#version: 0.2", *(" ".join(pair) for pair in merges)]
    _write(folder / "merges.txt", "\n".join(lines) + "\n")
    _write(folder / WORDS, "\n".join(words) + "\n")
    special = {"bos_token": START, "eos_token": END, "unk_token": END, "pad_token": END}
    _write_json(folder / "special_tokens_map.json", special)
    settings = {
        "model_max_length": LENGTH,
        "tokenizer_class": "CLIPTokenizer",
        "do_lower_case": True,
    }
    _write_json(folder / SETTINGS, special | settings)


def copy_tokenizer(source: Path, folder: Path) -> None:
    """Copy the files of a tokenizer.

    Raises:
        UserError: the disk is full, or the folder can't be written.
    """
    output_folder(folder, "the tokenizer")
    for path in sorted(source.iterdir(), key=lambda path: path.name == SETTINGS):
        with atomic_file(folder / path.name) as file:
            file.write(path.read_bytes())


def is_complete(folder: Path) -> bool:
    """Return whether the tokenizer in ``folder`` has been written to its end."""
    return (folder / SETTINGS).is_file()


def words_of(folder: Path) -> list[str]:
    """Return the list of words beside a tokenizer.

    Raises:
        UserError: there is none.
    """
    return existing_file(folder / WORDS, "list of words").read_text(encoding="utf-8").split()


def word_merges(words: Sequence[str]) -> list[tuple[str, str]]:
    """Return byte pair merges (Sennrich et al. 2016) that make each of ``words`` one token."""
    split = [[*word[:-1], f"{word[-1]}</w>"] for word in sorted(set(words))]
    merges = []
    while any(len(pieces) > 1 for pieces in split):
        counts: dict[tuple[str, str], int] = {}
        for pieces in split:
            for pair in zip(pieces, pieces[1:], strict=False):
                counts[pair] = counts.get(pair, 0) + 1
        best = min(counts, key=lambda pair: (-counts[pair], pair))
        split = [_merged(pieces, best) for pieces in split]
        merges.append(best)
    return merges


def byte_letters() -> list[str]:
    """Return the 256 letters that stand for bytes in GPT-2's and CLIP's vocabularies."""
    printable = [
        *range(ord("!"), ord("~") + 1),
        *range(ord("¡"), ord("¬") + 1),
        *range(ord("®"), ord("ÿ") + 1),
    ]
    return [*map(chr, printable), *(chr(256 + i) for i in range(256 - len(printable)))]


def _merged(pieces: list[str], pair: tuple[str, str]) -> list[str]:
    """Join each occurrence of ``pair`` in ``pieces``, from left to right."""
    out: list[str] = []
    for piece in pieces:
        if out and (out[-1], piece) == pair:
            out[-1] += piece
        else:
            out.append(piece)
    return out


def _write_json(path: Path, content: dict) -> None:
    _write(path, json.dumps(content, ensure_ascii=False, indent=0))


def _write(path: Path, text: str) -> None:
    with atomic_file(path) as file:
        file.write(text.encode())
