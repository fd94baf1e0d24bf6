"""The plain prompt processor, words that a model doesn't know, prompts that depend on the view."""

import pytest
import torch

from tests.helpers.refusals import refused
from threestudio_gaussiandreamer.host import find
from threestudio_gaussiandreamer.prompts import view_prompts
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
    refused(match, processed, **options)


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


def views(*pairs):
    elevation, azimuth = zip(*pairs, strict=True)
    return torch.tensor(elevation), torch.tensor(azimuth), torch.full((len(pairs),), 3.0)


def output(left_and_right=False):
    """Return embeddings at random; all rows of ``*_vd`` differ."""
    draw = torch.Generator().manual_seed(0)
    directions = view_prompts.view_directions(left_and_right=left_and_right)
    rows = [1, 1, len(directions), len(directions)]
    return view_prompts.PromptEmbeddings(
        *(torch.randn(count, 3, 5, generator=draw) for count in rows),
        directions=directions,
        direction2idx={direction.name: index for index, direction in enumerate(directions)},
        use_perp_neg=True,
        prompt="a fox",
        prompts_vd=[""] * len(directions),
    )


def assert_rows(out, where, rows):
    cond, uncond = out.get_text_embeddings(*where).chunk(2)
    assert torch.equal(cond, out.text_embeddings_vd[rows])
    assert torch.equal(uncond, out.uncond_text_embeddings_vd[rows])


def test_each_view_gets_the_prompt_of_its_direction():
    azimuths = {0.0: 1, 44.0: 1, 46.0: 0, 90.0: 0, -90.0: 0, 134.0: 0, 136.0: 2, 180.0: 2}
    azimuths[-180.0] = 2
    where = views(*((0.0, azimuth) for azimuth in azimuths), (70.0, 0.0))
    for turn in (0, 360):
        assert_rows(output(), (where[0], where[1] + turn, where[2]), [*azimuths.values(), 3])
    where = views((0.0, 90.0), (0.0, -90.0), (0.0, 0.0), (0.0, 180.0), (70.0, 90.0), (0.0, 450.0))
    assert_rows(output(left_and_right=True), where, [0, 1, 2, 3, 4, 0])


def test_without_view_dependence_every_view_gets_the_prompt_itself():
    out, where = output(), views((0.0, 0.0), (70.0, 180.0))
    cond, uncond = out.get_text_embeddings(*where, view_dependent_prompting=False).chunk(2)
    assert torch.equal(cond, out.text_embeddings.expand(2, -1, -1))
    assert torch.equal(uncond, out.uncond_text_embeddings.expand(2, -1, -1))


def test_perp_neg_by_hand():
    """A view between front and side, one between side and back, one from above."""
    out = output()
    where = views((0.0, -30.0), (10.0, 120.0), (80.0, 10.0))
    embeddings, weights = out.get_text_embeddings_perp_neg(*where)
    side, front, back, overhead = out.text_embeddings_vd
    positive, uncond = embeddings[:3], embeddings[3:6]
    negative = embeddings[6:].unflatten(0, (3, 2))
    torch.testing.assert_close(positive[0], 2 / 3 * front + 1 / 3 * side)
    torch.testing.assert_close(positive[1], 2 / 3 * side + 1 / 3 * back)
    assert torch.equal(positive[2], overhead)
    assert torch.equal(uncond, out.uncond_text_embeddings_vd[[1, 0, 3]])
    assert torch.equal(negative[0], torch.stack([front, side]))
    assert torch.equal(negative[1], torch.stack([side, front]))
    assert torch.equal(negative[2], out.uncond_text_embeddings_vd[[3, 3]])
    at = lambda name, r: -float(view_prompts.decay(name, torch.tensor(r)))  # noqa: E731
    expected = [[at("fs", 2 / 3), at("sf", 1 / 3)], [at("sb", 2 / 3), at("fsb", 2 / 3)], [0, 0]]
    torch.testing.assert_close(weights, torch.tensor(expected))
    assert (weights <= 0).all()


def test_perp_neg_of_left_and_right_sides():
    """A view's interpolation and negative prompts are those of its own side."""
    out = output(left_and_right=True)
    left, right, front, back, _ = out.text_embeddings_vd
    angles = views((0.0, 30.0), (0.0, -30.0), (0.0, 120.0), (0.0, -120.0))
    embeddings, weights = out.get_text_embeddings_perp_neg(*angles)
    positive, negative = embeddings[:4], embeddings[8:].unflatten(0, (4, 2))
    between = [(front, left), (front, right), (left, back), (right, back)]
    for row, (one, other) in enumerate(between):
        torch.testing.assert_close(positive[row], 2 / 3 * one + 1 / 3 * other)
    pairs = [(front, left), (front, right), (left, front), (right, front)]
    assert torch.equal(negative, torch.stack([torch.stack(pair) for pair in pairs]))
    assert torch.equal(weights[0], weights[1]) and torch.equal(weights[2], weights[3])
