"""Checkpoint files are complete or absent, damage is detected, and no code is executed."""

import os
import pickle
import random

import pytest
import torch

from tests.promises.commands import full_disk
from threestudio_gaussiandreamer.core.checkpoint_file import (
    load_checkpoint,
    load_file,
    newest_readable,
    save_file,
)
from threestudio_gaussiandreamer.core.errors import UserError
from threestudio_gaussiandreamer.launch.callbacks import AtomicCheckpointIO


def content(step: int = 7, size: int = 2000) -> dict:
    state = {"means": torch.arange(float(size)) + step}
    return {"state_dict": state, "epoch": 0, "global_step": step, "note": "text"}


def same(a: dict, b: dict) -> bool:
    return a["global_step"] == b["global_step"] and torch.equal(
        a["state_dict"]["means"], b["state_dict"]["means"]
    )


def test_plain_torch_and_this_package_read_each_others_files(tmp_path):
    save_file(tmp_path / "a.ckpt", content())
    assert same(load_checkpoint(tmp_path / "a.ckpt"), content())
    assert same(torch.load(tmp_path / "a.ckpt", weights_only=True), content())
    assert os.listdir(tmp_path) == ["a.ckpt"]
    torch.save(content(), tmp_path / "a.ckpt")
    assert same(load_checkpoint(tmp_path / "a.ckpt"), content())


def test_the_file_that_is_replaced_is_kept(tmp_path):
    path, kept = tmp_path / "last.ckpt", tmp_path / "last-prev.ckpt"
    for step in (1, 2, 3):
        save_file(path, content(step))
    assert [load_file(p)["global_step"] for p in (path, kept)] == [3, 2]
    # after a kill between keeping and replacing both are hard links to one file
    kept.unlink()
    os.link(path, kept)
    for name in (".last.ckpt.1-2.tmp", ".of another.ckpt.1-2.tmp"):
        (tmp_path / name).touch()
    save_file(path, content(4))
    left = [".of another.ckpt.1-2.tmp", "last-prev.ckpt", "last.ckpt"]
    assert sorted(os.listdir(tmp_path)) == left
    (tmp_path / f".{100 * 'a'}.1-2.tmp").touch()  # names of temporary files are cut
    save_file(tmp_path / f"{120 * 'a'}.ckpt", content(4))
    assert not (tmp_path / f".{100 * 'a'}.1-2.tmp").exists()
    assert [load_file(p)["global_step"] for p in (path, kept)] == [4, 3]


@pytest.mark.parametrize("own", [True, False])
def test_a_flipped_byte_never_gives_other_numbers(tmp_path, own):
    path = tmp_path / "a.ckpt"
    save_file(path, content()) if own else torch.save(content(), path)
    whole = path.read_bytes()
    rng = random.Random(0)
    refused = 0
    for _ in range(200):
        damaged = bytearray(whole)
        damaged[rng.randrange(len(whole))] ^= 1 << rng.randrange(8)
        path.write_bytes(damaged)
        try:
            assert same(load_file(path), content())
        except UserError as error:
            assert str(path) in str(error)
            refused += 1
    # every byte of ours is covered; a foreign archive has padding that no checksum covers
    assert refused == 200 if own else refused >= 150


def test_a_damaged_file_names_its_neighbours(tmp_path):
    save_file(tmp_path / "last.ckpt", content(1))
    save_file(tmp_path / "last.ckpt", content(2))
    data = bytearray((tmp_path / "last.ckpt").read_bytes())
    data[len(data) // 2] ^= 1
    (tmp_path / "last.ckpt").write_bytes(data)
    with pytest.raises(UserError, match="checksum doesn't match.*last-prev.ckpt"):
        load_file(tmp_path / "last.ckpt")
    assert newest_readable(tmp_path) == (tmp_path / "last-prev.ckpt", 1)
    assert newest_readable(tmp_path / "nothing") is None


def test_the_newest_of_a_folder_is_the_one_with_most_steps(tmp_path, caplog):
    """Not by name or time, which a copied folder doesn't preserve; older ones aren't verified."""
    for name, step in (("last", 4), ("epoch=0-step=6", 6), ("epoch=0-step=2", 2)):
        save_file(tmp_path / f"{name}.ckpt", content(step))
    (tmp_path / "foreign.ckpt").write_bytes(b"no checkpoint at all")
    assert newest_readable(tmp_path) == (tmp_path / "epoch=0-step=6.ckpt", 6)
    save_file(tmp_path / "last.ckpt", content(6))
    with open(tmp_path / "epoch=0-step=2.ckpt", "r+b") as older:
        older.seek(-1, os.SEEK_END)
        older.write(b"x")  # in the checksum
    assert newest_readable(tmp_path) == (tmp_path / "last.ckpt", 6)
    assert "foreign.ckpt" in caplog.text and "step=2" not in caplog.text


class Bomb:
    def __reduce__(self):
        return os.mkdir, ("exploded",)


def test_code_in_a_pickle_is_not_executed(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    torch.save({"state_dict": {}, "epoch": 0, "global_step": 0, "x": Bomb()}, "bomb.ckpt")
    (tmp_path / "bare.ckpt").write_bytes(pickle.dumps(Bomb()))
    for name, message in ("bomb.ckpt", "could run code"), ("bare.ckpt", "isn't a checkpoint"):
        with pytest.raises(UserError, match=message):
            AtomicCheckpointIO().load_checkpoint(name, weights_only=False)
    assert not (tmp_path / "exploded").exists()


def test_a_foreign_file_is_not_a_checkpoint(tmp_path):
    for foreign in ({"model": 1}, [1, 2], torch.ones(3)):
        torch.save(foreign, tmp_path / "a.ckpt")
        with pytest.raises(UserError, match="isn't a training checkpoint: no valid .*state_dict"):
            load_checkpoint(tmp_path / "a.ckpt")


def test_a_missing_file_lists_what_is_there(tmp_path):
    save_file(tmp_path / "last.ckpt", content())
    others = "others in this folder, not checked: .*last.ckpt"
    with pytest.raises(UserError, match=f"there is no checkpoint .*lst.ckpt; {others}"):
        load_file(tmp_path / "lst.ckpt")
    os.mkfifo(tmp_path / "fifo.ckpt")
    with pytest.raises(UserError, match="there is no checkpoint .*fifo.ckpt"):
        load_file(tmp_path / "fifo.ckpt")
    with pytest.raises(UserError, match="the checkpoint .*a.ckpt: the folder .* can't be made"):
        save_file(tmp_path / "last.ckpt" / "a.ckpt", content())


def test_a_full_disk_leaves_the_earlier_file_and_no_temporary_one(tmp_path):
    save_file(tmp_path / "last.ckpt", content(1))
    with full_disk(100_000), pytest.raises(UserError, match="cannot write .*untouched"):
        save_file(tmp_path / "last.ckpt", content(2, size=200_000))
    assert os.listdir(tmp_path) == ["last.ckpt"]
    assert load_file(tmp_path / "last.ckpt")["global_step"] == 1


def test_a_tensor_that_repeats_a_number_is_refused(tmp_path):
    """A copy of it would exhaust the memory; a weight that two layers share is fine."""
    base = torch.zeros(1000)
    torch.save({str(i): base[:] for i in range(2)}, tmp_path / "two.ckpt")
    assert load_file(tmp_path / "two.ckpt").keys() == {"0", "1"}
    torch.save({"x": [torch.zeros(1).expand(10**12)]}, tmp_path / "a.ckpt")
    with pytest.raises(UserError, match="bytes can't hold a tensor"):
        load_file(tmp_path / "a.ckpt")
