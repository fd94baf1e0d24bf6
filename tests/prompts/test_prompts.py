"""The plain prompt processor: the prompt is text, verbatim."""

import tracemalloc

import pytest

from threestudio_gaussiandreamer.core.errors import UserError
from threestudio_gaussiandreamer.host import find
from threestudio_gaussiandreamer.prompts.prompts import PlainPromptProcessor

TEXTS = [
    "a fox",
    "1984",
    "yes",
    "a fox: red",
    "robot #1",
    "[a] b",
    "'quoted\" text",
    "a/../../x",
    "🦊 fox",
    " spaces ",
]
TEXTS += ["x" * 4096, "two\nlines", ""]


def processed(**options):
    return find("plain-prompt-processor")(options)()


def test_is_registered():
    assert find("plain-prompt-processor") is PlainPromptProcessor


@pytest.mark.parametrize("text", TEXTS)
def test_prompts_are_text(text):
    assert processed(prompt=text, negative_prompt=text).prompt == text
    assert processed(negative_prompt=text).negative_prompt == text


@pytest.mark.parametrize("text", [*TEXTS, "${x}", "${oc.env:HOME}"])
@pytest.mark.parametrize("end", ["", "\n", "\r\n"])
def test_a_prompt_file_is_the_prompt_but_for_its_last_line_end(tmp_path, text, end):
    (tmp_path / "prompt.txt").write_bytes((text + end).encode())
    assert processed(prompt_file=str(tmp_path / "prompt.txt")).prompt == text


def test_only_one_line_end_is_stripped(tmp_path):
    (tmp_path / "prompt.txt").write_bytes(b"a fox\n\n")
    assert processed(prompt_file=str(tmp_path / "prompt.txt")).prompt == "a fox\n"


def test_view_dependent_prompts_are_in_the_order_of_the_host():
    expected = ["a fox, side view", "a fox, front view", "a fox, back view", "a fox, overhead view"]
    assert processed(prompt="a fox").prompts_vd == expected


def test_of_a_huge_prompt_file_only_the_beginning_is_read(tmp_path):
    with open(tmp_path / "prompt.txt", "wb") as file:
        file.truncate(1 << 30)  # sparse
    tracemalloc.start()
    with pytest.raises(UserError, match="more than"):
        processed(prompt_file=str(tmp_path / "prompt.txt"))
    assert tracemalloc.get_traced_memory()[1] < 16 << 20
    tracemalloc.stop()


def test_bad_prompt_files_are_named(tmp_path):
    (tmp_path / "prompt.txt").write_bytes(b"caf\xe9")
    with pytest.raises(UserError, match="prompt.txt' is not UTF-8 text .byte 3."):
        processed(prompt_file=str(tmp_path / "prompt.txt"))
    with pytest.raises(UserError, match="does not exist; near names.*prompt.txt"):
        processed(prompt_file=str(tmp_path / "promt.txt"))
    (tmp_path / "prompt.txt").write_bytes(b"a" * (1 << 21))
    with pytest.raises(UserError, match="more than"):
        processed(prompt_file=str(tmp_path / "prompt.txt"))
    with pytest.raises(UserError, match="both prompt and prompt_file"):
        processed(prompt="a fox", prompt_file=str(tmp_path / "prompt.txt"))
