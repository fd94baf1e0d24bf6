"""MDM's checkpoints: the files of its authors, the network, and HumanML3D's features."""

import json

import numpy as np
import pytest
import torch

from threestudio_gaussiandreamer.priors import text_to_motion as t2m


@pytest.fixture
def folder(tmp_path):
    """A tiny checkpoint with the files beside it, as MDM's authors publish them."""
    torch.manual_seed(0)
    network = t2m.MotionModel(16, 2, 32, 8)
    state, args = t2m.mdm_files(network, 50)
    torch.save(
        {"model": {**state, "clip_model.positional_embedding": torch.zeros(3)}},
        tmp_path / "full.pt",
    )
    torch.save(dict(state), tmp_path / "model000000050.pt")
    (tmp_path / "args.json").write_text(json.dumps(args), encoding="utf-8")
    np.save(tmp_path / "t2m_mean.npy", np.zeros(263))
    np.save(tmp_path / "t2m_std.npy", np.ones(263))
    return tmp_path


def test_a_published_checkpoint_is_read_and_sampled(folder):
    model = t2m.load_motion_model(str(folder / "model000000050.pt"))
    text = torch.randn(1, 8, generator=torch.Generator().manual_seed(1))

    def drawn(seed: int, text=text) -> np.ndarray:
        return t2m.sample_motions(model, text, 2, torch.Generator().manual_seed(seed), frames=6)

    first = drawn(0)
    assert first.shape == (2, 6, 22, 3) and np.isfinite(first).all()
    np.testing.assert_array_equal(first, drawn(0))
    assert not np.allclose(first, drawn(1)) and not np.allclose(first, drawn(0, -text))
