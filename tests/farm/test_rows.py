"""Prompt lists: what they may hold, and what is refused with its line."""

import json

import pytest

from threestudio_gaussiandreamer.core.errors import UserError
from threestudio_gaussiandreamer.farm.rows import MOST_LINE_BYTES, Row, check_rows, read_rows
from threestudio_gaussiandreamer.launch.run_folder import safe_name


def listed(tmp_path, text, suffix=".txt"):
    path = tmp_path / f"prompts{suffix}"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return path


def rows(*args):
    return list(read_rows(listed(*args)))


def test_a_text_has_a_prompt_per_line_and_comments(tmp_path):
    text = "\ufeff# animals\na fox\n\n  a red, round ball  \r\n#a cat\nnothing"
    assert rows(tmp_path, text) == [
        Row("a_fox", "a fox", line=2),
        Row("a_red,_round_ball", "a red, round ball", line=4),
        Row("nothing", "nothing", line=6),
    ]


def test_a_csv_has_columns(tmp_path):
    text = (
        "prompt, name, seed, overrides\n# a comment\n"
        '"a fox, running",fox,7,"trainer.max_steps=2 tag=\'a b\'"\na cat,,,\na dog,,3\n'
    )
    first, second, third = rows(tmp_path, text, ".csv")
    fox = Row("fox", "a fox, running", 7, (), ("trainer.max_steps=2", "tag=a b"))
    assert first == fox._replace(line=first.line)
    assert (second.name, second.seed, second.overrides) == ("a_cat", None, ())
    assert third.name == "a_dog-seed3" and [first.line, second.line, third.line] == [3, 4, 5]


def test_a_jsonl_has_objects(tmp_path):
    lines = [
        {"prompt": "a fox", "overrides": {"trainer.max_steps": 2, "name": "x"}, "config": "a.yaml"},
        {"prompt": "a cat", "overrides": ["a=1"], "config": ["a.yaml", "b.yaml"], "seed": 0},
    ]
    one, other = rows(tmp_path, "\n".join(map(json.dumps, lines)), ".jsonl")
    assert one.overrides == ("trainer.max_steps=2", "name=x") and one.config == ("a.yaml",)
    assert other.config == ("a.yaml", "b.yaml") and other.seed == 0


def test_the_key_depends_on_what_the_asset_depends_on():
    row = Row("a", "a fox", 1, ("a.yaml",), ("x=1",), 3)
    assert row.key == row._replace(name="b", line=9).key
    changes = {"prompt": "b", "seed": None, "config": (), "overrides": ()}
    others = {row._replace(**{name: changes[name]}).key for name in changes}
    assert len({row.key, *others}) == 5


def test_texts_that_are_no_folders_names_are_an_asset_each(tmp_path):
    long = "a photo of " * 9
    texts = [
        *(f"{long}fox", f"{long}cat", "caf\u00e9", "cafe\u0301", "\U0001f98a", "\U0001f98a!"),
        *("\U0001f468\u200d\U0001f467", "a\u00a0cat", "a/b", "../b", "..", ".a", "/a"),
        *("a fox.", "a fox..", "a fox", "CON", "nul", "con.txt", "com\u00b9", "\U0001fae9"),
    ]
    path = listed(tmp_path, "\r\n".join(texts))
    assert check_rows(path) == len(texts)
    found = list(read_rows(path))
    assert [row.prompt for row in found] == texts
    for row in found:
        assert safe_name(row.name) == row.name and "/" not in row.name
        assert row.name.split(".")[0].lower() not in ("", "con", "nul", "com\u00b9")


@pytest.mark.parametrize(
    ("text", "suffix", "message"),
    [
        ("", ".txt", "has no prompts"),
        ("prompt,name\n", ".csv", "has no prompts"),
        (b"\x89PNG\r\n\x1a\n\xff", ".txt", "bytes, or no UTF-8 text"),
        ("a fox\n" + "a" * 100_000, ".txt", f"line 2: longer than {MOST_LINE_BYTES} bytes"),
        ("a fox\na cat\na fox", ".txt", "lines 1 and 3 have the same name 'a_fox'"),
        ("A fox\na fox", ".txt", "lines 1 and 2 have the same name 'a_fox' (upper and lower case"),
        ("prompt\r\na fox".encode("utf-16"), ".csv", "which Excel saves as CSV UTF-8"),
        ("a fox\u2028a cat", ".txt", "line 1: the prompt 'a fox\\u2028a cat' has a line break"),
        ('{"prompt": "\\ud800"}', ".jsonl", "line 1: the prompt '\\ud800' has a line break"),
        ("a fox\na\x1b[0m", ".txt", "line 2: the prompt 'a\\x1b[0m' has a line break"),
        ("promt\na fox", ".csv", "unknown column 'promt': did you mean 'prompt'?"),
        ("a fox\n???", ".txt", "line 2: '???' can't be a text"),
        ("prompt;seed\na fox;1", ".csv", "by commas, with a column prompt; it is 'prompt;seed'"),
        ("name,seed\na,1", ".csv", "with a column prompt"),
        ("prompt\na fox, b", ".csv", "line 2: 2 cells for 1 columns"),
        ('prompt\n"a fox', ".csv", "line 2: unexpected end of data"),
        ("prompt,seed\na,4294967296", ".csv", "line 2: the seed is '4294967296'"),
        ("prompt,name\na,../b", ".csv", "line 2: the name '../b' can't be a folder's"),
        ("prompt,overrides\na,max_steps", ".csv", "line 2: the override 'max_steps' isn't"),
        ('prompt,overrides\na,"x=\'1"', ".csv", "open quote"),
        ('{"prompt": "a"', ".jsonl", "line 1: can't be read as JSON"),
        ('{"prompt": "a", "prompt": "b"}', ".jsonl", "'prompt' is given twice"),
        ("[" * 20_000, ".jsonl", "line 1: can't be read as JSON"),
        ('["a"]', ".jsonl", "line 1: expected an object"),
        ('{"prompt": 1}', ".jsonl", "line 1: the prompt is 1"),
        ('{"prompt": "a", "seed": true}', ".jsonl", "line 1: the seed is True"),
        ('{"prompt": "a", "name": 5}', ".jsonl", "the name '5' can't be"),
        ('{"prompt": "a", "config": 5}', ".jsonl", "config is 5; expected a text or a list"),
    ],
)
def test_what_is_wrong_is_named_with_its_line(tmp_path, text, suffix, message):
    with pytest.raises(UserError) as refused:
        check_rows(listed(tmp_path, text, suffix))
    assert message in str(refused.value)


def test_an_unknown_format_is_named(tmp_path):
    (tmp_path / "prompts.xlsx").touch()
    with pytest.raises(UserError, match="'.xlsx': choose from .csv, .jsonl, .ndjson, .txt"):
        list(read_rows(tmp_path / "prompts.xlsx"))
    listed(tmp_path, "a fox")
    with pytest.raises(UserError, match="prompt list .*prompt.txt' does not exist.*prompts.txt"):
        check_rows(tmp_path / "prompt.txt")
