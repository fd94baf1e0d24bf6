"""ImageReward's published format, and T3Bench's quality."""

import numpy as np
import pytest
import torch

from tests.helpers import tiny_image_reward as tiny
from tests.helpers.refusals import refused
from threestudio_gaussiandreamer.evaluation import t3bench
from threestudio_gaussiandreamer.models.clip import preprocessed

pytest.importorskip("transformers")
from threestudio_gaussiandreamer.evaluation.image_reward import ImageReward  # noqa: E402

CPU = torch.device("cpu")


@pytest.fixture
def pictures():
    rng = np.random.default_rng(0)
    return rng.random((3, tiny.SIZE, tiny.SIZE, 3)).astype(np.float32)


def test_rewards_are_those_of_the_formula(tmp_path, pictures):
    model = ImageReward(str(tiny.write(tmp_path / "ir")), CPU)
    found = model.rewards(pictures, "A red FOX", batch=2)
    ids = [tiny.WORDS.index(word) for word in ("[CLS]", "a", "red", "fox", "[SEP]")]
    expected = tiny.rewards(tiny.state_dict(), preprocessed(pictures, tiny.SIZE), ids)
    np.testing.assert_allclose(found, expected.numpy(), rtol=1e-4, atol=1e-5)
    assert np.ptp(found) > 1e-3
    assert np.isfinite(model.rewards(pictures, "a red fox " * 30)).all()  # which is cut


def without(part):
    return {name: value for name, value in tiny.state_dict().items() if part not in name}


@pytest.mark.parametrize(
    ("state", "said"),
    [
        ({}, "holds no weights by name"),
        (without("blip"), "no tensors, or misshapen ones, of a BLIP"),
        (without("mlp.layers.7"), "Missing key.*head.7.weight.*head.7.bias"),
        (without("crossattention"), "Missing key.*text.encoder.layer.0.crossattention"),
        (tiny.state_dict() | {"mlp.layers.9.bias": torch.zeros(1)}, "Unexpected key.*head.9.bias"),
        (tiny.state_dict() | {"blip.visual_encoder.pos_embed": torch.zeros(3)}, "misshapen ones"),
    ],
)
def test_other_files_are_refused(tmp_path, state, said):
    folder = tiny.write(tmp_path / "ir", state)
    refused(said, ImageReward, str(folder), CPU)


@pytest.mark.parametrize(
    ("name", "content", "said"),
    [
        ("ImageReward.pt", None, "ImageReward.pt is missing: `hf download .*.pt --local-dir"),
        ("vocab.txt", None, "vocab.txt is missing: `hf download .*vocab.txt --local-dir"),
        ("vocab.txt", b"hello\n", "no vocabulary of BERT"),
        ("vocab.txt", b"\xff\xfe\x00", "no vocabulary of BERT"),
    ],
)
def test_a_missing_or_other_file_is_named(tmp_path, name, content, said):
    folder = tiny.write(tmp_path / "ir")
    if content is None:
        (folder / name).unlink()
    else:
        (folder / name).write_bytes(content)
    refused(said, ImageReward, str(folder), CPU)


def test_the_best_smoothed_vertex_counts_with_its_best_camera():
    import trimesh

    neighbours = trimesh.creation.icosphere(subdivisions=2).vertex_neighbors
    assert t3bench.quality(np.full((162, 5), 1.5)) == pytest.approx(20 * 1.5 + 50)
    rewards = np.zeros((162, 5))
    rewards[0, 3] = 7.0  # one of the twelve vertices with five neighbours
    scores = dict.fromkeys(range(162), 0.0) | {0: 7.0}
    for _ in range(3):
        scores = {
            vertex: (scores[vertex] + sum(scores[n] for n in near)) / (len(near) + 1)
            for vertex, near in enumerate(neighbours)
        }
    assert t3bench.quality(rewards) == pytest.approx(20 * max(scores.values()) + 50)
