"""Prompts that depend on the view, and Perp-Neg."""

import pytest
import torch

from tests.prompts.prompt_processors_cases import processor
from threestudio_gaussiandreamer.prompts.view_prompts import (
    PromptEmbeddings,
    decay,
    view_directions,
)

pytest.importorskip("diffusers")


def views(*pairs):
    elevation, azimuth = zip(*pairs, strict=True)
    return torch.tensor(elevation), torch.tensor(azimuth), torch.full((len(pairs),), 3.0)


# Directions
# --------------------------------------------------------------------------------------------------


def test_each_view_gets_the_prompt_of_its_direction(models):
    out = processor(models)()
    assert out.prompts_vd == [
        "a fox, side view",
        "a fox, front view",
        "a fox, back view",
        "a fox, overhead view",
    ]
    azimuths = {
        0.0: 1,
        90.0: 0,
        -90.0: 0,
        180.0: 2,
        -180.0: 2,
        44.0: 1,
        46.0: 0,
        134.0: 0,
        136.0: 2,
    }
    where, rows = (
        views(*((0.0, azimuth) for azimuth in azimuths), (70.0, 0.0)),
        [*azimuths.values(), 3],
    )
    cond, uncond = out.get_text_embeddings(*where).chunk(2)
    assert torch.equal(cond, out.text_embeddings_vd[rows])
    assert torch.equal(uncond, out.uncond_text_embeddings_vd[rows])
    turned = (where[0], where[1] + 360, where[2])
    assert torch.equal(out.get_text_embeddings(*turned), out.get_text_embeddings(*where))


def test_left_and_right_sides_have_their_own_prompts(models):
    out = processor(models, view_dependent_left_and_right=True)()
    names = ("left side", "right side", "front", "back", "overhead")
    assert out.prompts_vd == [f"a fox, {name} view" for name in names]
    where = views((0.0, 90.0), (0.0, -90.0), (0.0, 0.0), (0.0, 180.0), (70.0, 90.0), (0.0, 450.0))
    cond, uncond = out.get_text_embeddings(*where).chunk(2)
    assert torch.equal(cond, out.text_embeddings_vd[[0, 1, 2, 3, 4, 0]])
    assert torch.equal(uncond, out.uncond_text_embeddings_vd[[0, 1, 2, 3, 4, 0]])
    assert not torch.equal(cond[0], cond[1])
    same = processor(models, view_dependent_left_and_right=True, prompt_side="a fox's flank")()
    assert same.prompts_vd[:2] == ["a fox's flank"] * 2


def test_perp_neg_of_left_and_right_sides(models):
    """A view's interpolation and negative prompts are those of its own side."""
    out = processor(models, use_perp_neg=True, view_dependent_left_and_right=True)()
    left, right, front, back, _ = out.text_embeddings_vd
    angles = views((0.0, 30.0), (0.0, -30.0), (0.0, 120.0), (0.0, -120.0))
    embeddings, weights = out.get_text_embeddings_perp_neg(*angles)
    positive, negative = embeddings[:4], embeddings[8:].unflatten(0, (4, 2))
    for row, (one, other, share) in enumerate(
        [(front, left, 2 / 3), (front, right, 2 / 3), (left, back, 2 / 3), (right, back, 2 / 3)]
    ):
        torch.testing.assert_close(positive[row], share * one + (1 - share) * other)
    for row, pair in enumerate([(front, left), (front, right), (left, front), (right, front)]):
        assert torch.equal(negative[row], torch.stack(pair))
    assert torch.equal(weights[0], weights[1]) and torch.equal(weights[2], weights[3])


def test_without_view_dependence_every_view_gets_the_prompt_itself(models):
    out = processor(models)()
    cond, uncond = out.get_text_embeddings(
        *views((0.0, 0.0), (70.0, 180.0)), view_dependent_prompting=False
    ).chunk(2)
    assert torch.equal(cond, out.text_embeddings.expand(2, -1, -1))
    assert torch.equal(uncond, out.uncond_text_embeddings.expand(2, -1, -1))


def test_thresholds_and_prompts_of_the_user(models):
    out = processor(
        models,
        prompt_back="the tail of a fox",
        front_threshold=30.0,
        back_threshold=60.0,
        overhead_threshold=40.0,
    )()
    assert out.prompts_vd[2] == "the tail of a fox"
    indices = out.direction_indices(*views((0.0, 35.0), (0.0, 125.0), (45.0, 0.0)))
    assert indices.tolist() == [0, 2, 3]
    out = processor(models, view_dependent_prompt_front=True)()
    assert out.prompts_vd == [
        "side view of a fox",
        "front view of a fox",
        "backside view of a fox",
        "overhead view of a fox",
    ]


# Perp-Neg
# --------------------------------------------------------------------------------------------------


def perp_neg_output(seed=0):
    draw = torch.Generator().manual_seed(seed)
    rows = {
        name: torch.randn(4 if name.endswith("vd") else 1, 3, 5, generator=draw)
        for name in EMBEDDINGS
    }
    directions = view_directions(45, 45, 60)
    coefficients = {
        "sb": (1.0, 0.5, -0.606),
        "fsb": (1.0, 0.5, 0.967),
        "fs": (4.0, 0.5, -2.426),
        "sf": (4.0, 0.5, -2.426),
    }
    return PromptEmbeddings(
        **rows,
        directions=directions,
        direction2idx={direction.name: index for index, direction in enumerate(directions)},
        use_perp_neg=True,
        **{f"perp_neg_f_{name}": value for name, value in coefficients.items()},
        prompt="a fox",
        prompts_vd=[""] * 4,
    )


EMBEDDINGS = (
    "text_embeddings",
    "uncond_text_embeddings",
    "text_embeddings_vd",
    "uncond_text_embeddings_vd",
)


def test_perp_neg_by_hand():
    """A view between front and side, one between side and back, one from above; the numbers are
    computed here.
    """
    out = perp_neg_output()
    embeddings, weights = out.get_text_embeddings_perp_neg(
        *views((0.0, -30.0), (10.0, 120.0), (80.0, 10.0))
    )
    side, front, back, overhead = out.text_embeddings_vd
    positive, uncond, negative = (
        embeddings[:3],
        embeddings[3:6],
        embeddings[6:].unflatten(0, (3, 2)),
    )
    torch.testing.assert_close(positive[0], 2 / 3 * front + 1 / 3 * side)
    torch.testing.assert_close(positive[1], 2 / 3 * side + 1 / 3 * back)
    assert torch.equal(positive[2], overhead)
    assert torch.equal(uncond, out.uncond_text_embeddings_vd[[1, 0, 3]])
    assert torch.equal(negative[0], torch.stack([front, side]))
    assert torch.equal(negative[1], torch.stack([side, front]))
    assert torch.equal(negative[2], out.uncond_text_embeddings_vd[[3, 3]])
    at = lambda coefficients, r: -float(decay(coefficients, torch.tensor(r)))  # noqa: E731
    expected = [
        [at(out.perp_neg_f_fs, 2 / 3), at(out.perp_neg_f_sf, 1 / 3)],
        [at(out.perp_neg_f_sb, 2 / 3), at(out.perp_neg_f_fsb, 2 / 3)],
        [0.0, 0.0],
    ]
    torch.testing.assert_close(weights, torch.tensor(expected))
    assert (weights <= 0).all()


def test_perp_neg_of_a_batch_is_perp_neg_of_each_view():
    out = perp_neg_output()
    where = views((0.0, 0.0), (10.0, 100.0), (70.0, 20.0), (-5.0, -170.0))
    embeddings, weights = out.get_text_embeddings_perp_neg(*where)
    for i in range(4):
        alone, weight = out.get_text_embeddings_perp_neg(*(values[i : i + 1] for values in where))
        assert torch.equal(alone, embeddings[[i, 4 + i, 8 + 2 * i, 9 + 2 * i]])
        assert torch.equal(weight[0], weights[i])
