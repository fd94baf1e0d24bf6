"""The plain prompt processor: the prompt is text, verbatim; words that a model doesn't know."""

import pytest

from threestudio_gaussiandreamer.core.errors import UserError
from threestudio_gaussiandreamer.host import find
from threestudio_gaussiandreamer.prompts.prompts import WORDS_FILE, warn_of_unknown_words

TEXTS = ["1984", "yes", "a fox: red", "robot #1", "[a] b", "'quoted\" text", "a/../../x"]
TEXTS += ["🦊 fox", " spaces ", "x" * 4096, "two\nlines", "", "${x}", "${oc.env:HOME}"]


def processed(**options):
    return find("plain-prompt-processor")(options)()


@pytest.mark.parametrize("text", TEXTS)
def test_a_prompt_is_text_and_a_file_all_of_it_but_its_last_line_end(tmp_path, text):
    if "${" not in text:
        out = processed(prompt=text, negative_prompt=text)
        assert out.prompt == out.negative_prompt == text
    for end in ("", "\n", "\r\n", "\n\n"):
        (tmp_path / "prompt.txt").write_bytes((text + end).encode())
        found = processed(prompt_file=str(tmp_path / "prompt.txt")).prompt
        assert found == text + ("\n" if end == "\n\n" else "")
    # view-dependent ones are in the order of the host
    expected = ["a fox, side view", "a fox, front view", "a fox, back view", "a fox, overhead view"]
    assert processed(prompt="a fox").prompts_vd == expected


@pytest.mark.parametrize(
    "options, match",
    [
        ({"prompt_file": "prompt.txt"}, "prompt.txt': it isn't UTF-8 text .*position 3"),
        ({"prompt_file": "promt.txt"}, "does not exist; near names.*prompt.txt"),
        ({"prompt_file": "prompt.txt", "prompt": "a fox"}, "both prompt and prompt_file"),
    ],
)
def test_bad_prompt_files_are_named(tmp_path, monkeypatch, options, match):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "prompt.txt").write_bytes(b"caf\xe9")
    with pytest.raises(UserError, match=match):
        processed(**options)


@pytest.mark.parametrize(
    "prompt, parts",
    [
        ("a readd zebra, a 3d ZEBRA", ["'readd' (near: red)", "'zebra'; it", "'zebra'"]),
        ("a Red fox! 3d", []),
        ("  ...", []),
        ("赤い狐 " * 500, ["trained on"]),
        ("x" * 4000, ["trained on"]),
        ("🦊 \0 zebra", ["'zebra'"]),
    ],
)
def test_words_that_a_model_does_not_know_are_named(tmp_path, caplog, prompt, parts):
    warn_of_unknown_words(tmp_path, "a zebra")  # a model without a list
    assert not caplog.text
    (tmp_path / WORDS_FILE).parent.mkdir()
    (tmp_path / WORDS_FILE).write_text("a\n3\nd\nfox\nred\n")
    warn_of_unknown_words(tmp_path, prompt)
    assert len(caplog.records) == bool(parts)
    if parts:
        message = caplog.records[0].getMessage()
        assert message.count("zebra") == ("zebra" in prompt) and len(message) < 600
        assert all(part in message for part in parts[:1] + parts[2:])
