"""Motion files are read without running code of theirs; damaged ones are rejected."""

import numpy as np
import pytest

from tests.priors.motion_cases import walk
from threestudio_gaussiandreamer.core.errors import UserError
from threestudio_gaussiandreamer.priors.motion import read_motions

# --------------------------------------------------------------------------------------------------
# files of motions


def test_mdms_layout_is_read(motion_file, body):
    motions = read_motions(str(motion_file))
    assert (
        motions.positions.shape == (2, 6, 22, 3)
        and motions.lengths == [6, 4]
        and motions.texts == ["Someone kicks"] * 2
    )
    np.testing.assert_array_equal(motions.positions[0], walk(body))


@pytest.mark.parametrize("joints", [22, 24])
def test_bare_arrays_are_read(tmp_path, joints):
    frames = np.random.default_rng(0).normal(size=(5, joints, 3))
    for array in (frames, frames.transpose(1, 2, 0), frames.transpose(1, 2, 0)[None]):
        np.save(tmp_path / "motion.npy", array.astype(np.float32))
        motions = read_motions(str(tmp_path / "motion.npy"))
        np.testing.assert_allclose(motions.positions, frames[None], atol=1e-6)
        assert motions.lengths == [5] and motions.texts is None


class Evil:
    def __reduce__(self):
        return (exec, ("import os; os.environ['EVIL'] = '1'",))


def test_the_file_of_mdm_is_read_and_runs_no_code(tmp_path, body, monkeypatch):
    import os

    monkeypatch.delenv("EVIL", raising=False)
    results = {
        "motion": walk(body).transpose(1, 2, 0)[None],
        "text": ["Someone kicks"],
        "lengths": np.array([6]),
        "num_samples": 1,
        "num_repetitions": 1,
    }
    np.save(tmp_path / "results.npy", results)
    read = read_motions(str(tmp_path / "results.npy"))
    np.testing.assert_array_equal(read.positions[0], walk(body))
    assert read.texts == ["Someone kicks"] and read.lengths == [6]
    np.save(tmp_path / "evil.npy", np.array({"motion": Evil()}, dtype=object))
    np.savez(tmp_path / "evil.npz", motion=np.array(Evil(), dtype=object))
    for name in ("evil.npy", "evil.npz"):
        with pytest.raises(UserError, match="pickle|holds an object 'exec'"):
            read_motions(str(tmp_path / name))
    assert "EVIL" not in os.environ


@pytest.mark.parametrize(
    "arrays, message",
    [
        ({"joints": np.zeros((1, 22, 3, 5))}, "no array 'motion', only joints"),
        ({"motion": np.zeros((1, 25, 6, 5))}, "rotations"),
        ({"motion": np.zeros((1, 21, 3, 5))}, r"\(1, 21, 3, 5\).*22 or 24 joints"),
        ({"motion": np.zeros((1, 22, 3, 0))}, "without a frame"),
        ({"motion": np.full((1, 22, 3, 5), "x")}, "not numbers"),
        ({"motion": np.full((1, 22, 3, 5), np.nan)}, "NaN"),
        ({"motion": np.zeros((2, 22, 3, 5)), "lengths": np.array([5])}, "lengths must be 2"),
        ({"motion": np.zeros((1, 22, 3, 5)), "lengths": np.array([6])}, "from 1 to 5"),
    ],
)
def test_other_arrays_are_refused(tmp_path, arrays, message):
    np.savez(tmp_path / "motion.npz", **arrays)
    with pytest.raises(UserError, match=message):
        read_motions(str(tmp_path / "motion.npz"))


def test_padding_may_be_anything(tmp_path):
    motion = np.zeros((1, 22, 3, 5))
    motion[..., 3:] = np.nan
    np.savez(tmp_path / "motion.npz", motion=motion, lengths=np.array([3]))
    assert read_motions(str(tmp_path / "motion.npz")).lengths == [3]


@pytest.mark.parametrize("content", [b"", b"not an array", b"PK\x03\x04 broken"])
def test_damaged_motion_files(tmp_path, content):
    (tmp_path / "motion.npz").write_bytes(content)
    with pytest.raises(UserError, match="motion file"):
        read_motions(str(tmp_path / "motion.npz"))
    with pytest.raises(UserError, match="near names.*motion.npz"):
        read_motions(str(tmp_path / "motions.npz"))
