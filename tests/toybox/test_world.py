"""The toybox's objects, prompts, pictures and tokenizer, as functions of (seed, index)."""

import os

import numpy as np
import pytest
import torch

from threestudio_gaussiandreamer.meshes.load import AXES
from threestudio_gaussiandreamer.toybox import motions, views, words, world
from threestudio_gaussiandreamer.toybox.demo import contact_sheet
from threestudio_gaussiandreamer.toybox.kinds import ACCESSORIES, KINDS
from threestudio_gaussiandreamer.toybox.loop import StepData
from threestudio_gaussiandreamer.toybox.tokens import LENGTH, write_tokenizer

MANY = 400


@pytest.fixture(scope="module")
def drawn():
    return [world.draw_attributes(0, index) for index in range(MANY)]


def mesh_of(attributes, seed=0):
    return world.object_mesh(attributes, np.random.default_rng(seed))


def test_objects_are_functions_of_seed_and_index(drawn):
    assert len(KINDS) >= 16 and len(world.COLORS) == 12 and len(world.PATTERNS) == 5
    assert {a.kind for a in drawn} == {*KINDS, "person"} == set(words.NOUNS) == set(words.PARTS)
    assert {a.action for a in drawn} == {None, *motions.names()}
    assert {a.pattern for a in drawn} == set(world.PATTERNS)
    assert {a.accessory for a in drawn} == {None, *ACCESSORIES} and any(a.part for a in drawn)
    assert drawn[7] == world.draw_attributes(0, 7)
    assert [world.draw_attributes(1, index) for index in range(20)] != drawn[:20]
    for a in drawn:
        named = [c for c in (a.color, a.second, a.part, a.accessory_color) if c]
        assert len(set(named)) == len(named)
        assert (a.second is None) == (a.pattern == "plain")
    assert not any(world.withheld(a) for a in drawn)
    assert all(world.withheld(world.draw_attributes(0, i, held_out=True)) for i in range(20))
    assert all(views.attributes_of(views.label_row(a, 50)) == a for a in drawn)
    # every kind and colour is learnt from other objects
    assert not any(world.withheld(world.Attributes(k, c)) for k in KINDS for c in world.COLORS)


@pytest.mark.parametrize("kind", KINDS)
def test_every_kind_has_a_mesh_inside_the_sphere_with_patterns_on_all_sides(kind):
    for accessory in (None, *world.THINGS_WORN):
        color = "red" if accessory else None
        mesh = mesh_of(world.Attributes(kind, "blue", "dotted", "white", None, accessory, color))
        assert np.linalg.norm(mesh.vertices, axis=1).max() == pytest.approx(world.RADIUS)
        assert np.isfinite(mesh.uv).all() and (0 <= mesh.uv).all() and (mesh.uv <= 1).all()
        assert world.PART_SHADE * 0.69 < mesh.vertex_colors.min() <= mesh.vertex_colors.max() <= 1
    for pattern in world.PATTERNS[1:]:
        points = points_of(world.Attributes(kind, "blue", pattern, "yellow"))
        yellow = hue_matches(points[:, 3:], "yellow")
        around = np.degrees(np.arctan2(points[:, 1], points[:, 0]))
        for side in range(4):
            inside = np.abs((around - 90 * side + 180) % 360 - 180) < 45
            assert yellow[inside].sum() > 0.05 * inside.sum()
    # no surface has more periods than the texture
    share = world.SIZE / (world.SIZE + world.CELL)
    for seed in range(10):
        u, v = mesh_of(world.Attributes(kind, "blue", "dotted", "yellow"), seed).uv.T
        assert u[u < share].max() < share * (1 - 1 / world.SIZE) and v.max() < 1 - 1 / world.SIZE


def test_accessories_patterns_and_parts_show_in_their_colors():
    """A part without a colour of its own has the pattern, but is darker."""
    for kind in ("fox", "house", "robot"):
        for name in world.THINGS_WORN:
            attributes = world.Attributes(kind, "blue", accessory=name, accessory_color="lime")
            assert share_of(attributes, "lime") > 0.01, name
            assert share_of(world.Attributes(kind, "blue"), "lime") == 0
    for pattern in world.PATTERNS[1:]:
        mug = world.Attributes("mug", "blue", pattern, "yellow")
        assert share_of(mug, "blue") > 0.1 and share_of(mug, "yellow") > 0.1

    def sail(**part):
        points = points_of(world.Attributes("boat", "blue", "checkered", "yellow", **part))
        return points[points[:, 2] > 0.2]

    yellow = hue_matches(sail()[:, 3:], "yellow")
    assert 0.2 < yellow.mean() < 0.8
    assert sail()[yellow, 3].max() < world.PART_SHADE
    assert not hue_matches(sail(part="red")[:, 3:], "yellow").any()


def test_two_tone_has_the_second_color_above_and_the_front_is_plus_x():
    points = points_of(world.Attributes("penguin", "blue", "two-tone", "yellow"))
    blue, yellow = (points[hue_matches(points[:, 3:], name), 2] for name in ("blue", "yellow"))
    assert yellow.mean() > blue.mean() + 0.2
    points = points_of(world.Attributes("duck", "blue"))
    beak = points[hue_matches(points[:, 3:], "orange")]
    assert (beak[beak[:, 2] > 0, :3] @ AXES["+x"]).min() > 0.1  # without the feet


def test_a_person_wears_its_colors_has_the_cape_behind_and_kicks_ahead_with_its_own_leg():
    for side, sign in (("left", 1), ("right", -1)):  # left is +y
        clothes = {"part": "yellow", "accessory": "cape", "accessory_color": "lime"}
        points = points_of(world.Attributes("person", "blue", **clothes, action=f"kick {side}"))
        assert np.linalg.norm(points[:, :3], axis=1).max() <= world.RADIUS + 1e-3
        shirt, trousers, cape = (
            points[hue_matches(points[:, 3:], name), :3] for name in ("blue", "yellow", "lime")
        )
        assert min(map(len, (shirt, trousers, cape))) > 0.03 * len(points)
        assert cape[:, 0].mean() < shirt[:, 0].mean() and shirt[:, 2].min() > trousers[:, 2].min()
        assert sign * trousers[trousers[:, 0].argmax(), 1] > 0


def points_of(attributes):
    rng = np.random.default_rng(0)
    return views.surface_points(world.object_mesh(attributes, rng), rng).astype(np.float32)


def hue_matches(colors, name):
    """Rows whose direction of colour is that of a named colour, whatever the light."""
    unit = colors / np.linalg.norm(colors, axis=1, keepdims=True).clip(1e-6)
    wanted = np.array(world.COLORS[name])
    return unit @ (wanted / np.linalg.norm(wanted)) > 0.995


def share_of(attributes, color):
    """Of the points on its surface."""
    return hue_matches(points_of(attributes)[:, 3:], color).mean()


# Prompts ------------------------------------------------------------------------------------


def test_prompts_name_what_there_is(drawn):
    rng = np.random.default_rng(0)
    for attributes in drawn:  # every written prompt is read back
        text = words.describe(attributes, rng)
        assert words.attributes_in(text) == attributes, text
        assert " a o" not in f" {text}" and " a e" not in f" {text}"
    texts = [words.prompt_of(a, 10, 5 * i, rng) for i, a in enumerate(drawn) for _ in range(5)]
    assert np.mean([text == "" for text in texts]) == pytest.approx(0.1, abs=0.02)
    assert np.mean(["view" in text for text in texts]) == pytest.approx(0.7, abs=0.04)


@pytest.mark.parametrize(
    ("prompt", "attributes"),
    [
        (
            "A Red FOX, with a green scarf!",
            world.Attributes("fox", "red", accessory="scarf", accessory_color="green"),
        ),
        ("a shiny light green lorry from above", world.Attributes("truck", "lime")),
        ("a blue teddy bear and a horse", world.Attributes("bear", "blue")),
        ("a carrot coloured blue car", world.Attributes("car", "blue")),
        (
            "a woman in a navy jacket and pink pants kicks with her left foot",
            world.Attributes("person", "blue", part="pink", action="kick left"),
        ),
        (
            "a person in a red shirt and blue trousers",
            world.Attributes("person", "red", part="blue"),
        ),
        *((prompt, None) for prompt in ("", "a fox", "something red", "狐狸", "a " * 2000)),
    ],
)
def test_other_prompts_are_read(prompt, attributes):
    assert words.attributes_in(prompt) == attributes


# Tokenizer ----------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def tokenizer(tmp_path_factory):
    from transformers import CLIPTokenizer

    folder = tmp_path_factory.mktemp("tokenizer")
    write_tokenizer(folder, words.vocabulary())
    return CLIPTokenizer.from_pretrained(str(folder))


def test_every_word_is_one_token(tokenizer, drawn):
    for word in words.vocabulary():
        assert len(tokenizer(word).input_ids) == 3, word
    rng = np.random.default_rng(0)
    texts = [words.prompt_of(a, 10, 90, rng) for a in drawn]
    assert max(len(tokenizer(text).input_ids) for text in texts) <= LENGTH
    whole = {"padding": "max_length", "truncation": True, "max_length": LENGTH}
    for text in ("", "a wombat", "Ein Fuchs, über 火 🦊", "x" * 4096, "\x00\t\n"):
        ids = tokenizer(text, **whole).input_ids
        assert len(ids) == LENGTH and max(ids) < len(tokenizer)
        assert ids[0] == len(tokenizer) - 2 and len(tokenizer) - 1 in ids


# Pictures -----------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def shards(tmp_path_factory):
    return views.Shards(tmp_path_factory.mktemp("shards"), 0, objects=6, views=4)


def test_a_shard_is_a_function_of_seed_and_index(shards):
    left, fresh = (shards.folder / f".{shards.path(0).name}.{i}-7.tmp" for i in (1, 2))
    left.touch(), fresh.touch(), os.utime(left, (0, 0))
    shard, again = shards.get(0), shards.make(0)
    assert not left.exists() and fresh.exists()  # of a killed process, and of one that writes
    fresh.unlink()
    for first, second in zip(shard, again, strict=True):
        assert np.array_equal(first, second)
    assert not np.array_equal(shard.rgba, shards.make(1).rgba)
    name = f"train-world{world.VERSION}-0-6x4-00000.npz"
    assert [path.name for path in shards.folder.iterdir()] == [name]
    for row in range(24):
        attributes = views.attributes_of(shard.labels[row])
        assert attributes == world.draw_attributes(0, row // 4)
        assert np.array_equal(shard.labels[row], views.label_row(attributes, shard.azimuth[row]))
    for azimuth, name in ((0, "front"), (44, "front"), (46, "left"), (180, "back"), (-90, "right")):
        row = views.label_row(world.Attributes("fox", "red"), azimuth)
        assert views.LABELS["quadrant"][row[-1]] == name


def test_objects_fill_the_picture_and_are_not_cut(shards):
    alpha = shards.get(0).rgba[..., 3]
    for picture in alpha:
        assert not picture[[0, -1]].any() and not picture[:, [0, -1]].any()
    extents = [max(np.ptp(np.nonzero(picture)[axis]) for axis in (0, 1)) for picture in alpha]
    assert np.median(extents) > 0.6 * views.SIZE


def test_backgrounds_are_fixed_but_for_the_asked_share(shards):
    rgba = shards.get(0).rgba
    fixed = views.with_backgrounds(rgba, np.random.default_rng(0), random_share=0)
    assert torch.equal(fixed[:, :, 0, 0], torch.tensor(views.BACKGROUND).expand(24, 3))
    random = views.with_backgrounds(rgba, np.random.default_rng(0), random_share=1)
    assert (random[:, :, 0, 0] - fixed[:, :, 0, 0]).abs().amax(dim=1).min() > 0
    inside = rgba[0, :, :, 3] == 255
    colors = rgba[0, :, :, :3][inside] / 255
    assert np.allclose(random[0].movedim(0, -1).numpy()[inside], colors, atol=1e-6)


def test_a_batch_is_a_function_of_its_step(shards):
    data = StepData(shards, 5, 2, "x", lambda index, rows, rng: (index, rows))
    first, again = [data(step) for step in range(9)], data(6)
    assert first[6][0] == again[0] and np.array_equal(first[6][1], again[1])
    # 24 pictures are four batches of 5: the same shard, no picture twice
    assert [index for index, _ in first] == [0] * 4 + [1] * 4 + [0]
    assert len(set(np.concatenate([rows for _, rows in first[:4]]))) == 20


def test_texts_of_a_sheet_are_wrapped_below_the_pictures():
    pictures = torch.ones(2, 3, 64, 64)
    sheets = [contact_sheet(pictures, text, columns=2) for text in ((), ("a", "word " * 60))]
    assert [len(sheet) for sheet in sheets] == [64, 64 + 30 * 11 + 3]  # two words a line
    assert (sheets[1][:64] == 255).all() and (sheets[1][64:, 64:] < 128).any()
