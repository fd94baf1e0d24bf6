"""Prompts that depend on the view, and Perp-Neg."""

import torch

from threestudio_gaussiandreamer.prompts.view_prompts import (
    PromptEmbeddings,
    decay,
    view_directions,
)


def views(*pairs):
    elevation, azimuth = zip(*pairs, strict=True)
    return torch.tensor(elevation), torch.tensor(azimuth), torch.full((len(pairs),), 3.0)


def output(left_and_right=False):
    """Return embeddings at random; all rows of ``*_vd`` differ."""
    draw = torch.Generator().manual_seed(0)
    directions = view_directions(left_and_right=left_and_right)
    rows = [1, 1, len(directions), len(directions)]
    return PromptEmbeddings(
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
    """A view between front and side, one between side and back, one from above; the numbers are
    computed here.
    """
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
    at = lambda name, r: -float(decay(name, torch.tensor(r)))  # noqa: E731
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
