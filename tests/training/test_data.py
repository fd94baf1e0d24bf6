"""Batches have the host's keys and are a function of (seed, step)."""

import itertools
import math

import pytest
import torch

from tests.helpers.refusals import refused
from threestudio_gaussiandreamer.training.data import GaussianDreamerDataModule, orbit_batch

KEYS = dict.fromkeys(("elevation", "azimuth", "camera_distances", "fovy"), (4,))
KEYS |= dict.fromkeys(("camera_positions", "light_positions"), (4, 3))
KEYS |= dict.fromkeys(("c2w", "mvp_mtx", "proj_mtx"), (4, 4, 4))


def module(**cfg):
    data = GaussianDreamerDataModule({"batch_size": 4, "height": 32, "width": 48, **cfg})
    data.setup("fit")
    return data


def batches(data, count, start=0):
    data.train_dataset.next_step = lambda: start
    return list(itertools.islice(iter(data.train_dataloader()), count))


def test_batches_have_the_hosts_keys_shapes_and_units():
    (batch,) = batches(module(), 1)
    assert {k: tuple(v.shape) for k, v in batch.items() if torch.is_tensor(v)} == KEYS
    assert batch["height"] == 32 and batch["width"] == 48
    assert batch["fovy"].max() < math.pi and batch["azimuth"].abs().max() > 10  # radians, degrees
    assert torch.equal(batch["camera_positions"], batch["c2w"][:, :3, 3])
    data = module(n_val_views=4, n_test_views=5, eval_height=20, eval_width=30)
    val, test = list(data.val_dataloader()), list(data.test_dataloader())
    assert [b["azimuth"].item() for b in val] == [0, 90, 180, 270]
    assert [b["azimuth"].item() for b in test] == pytest.approx([0, 72, 144, 216, 288])
    assert val[2]["index"].tolist() == [2] and val[2]["height"] == 20
    assert val[2]["c2w"].shape == (1, 4, 4)


def test_groups_of_views_share_all_but_their_evenly_spaced_azimuths():
    for batch in batches(module(batch_size=8, n_view=4, azimuth_range=[150, 180]), 5):
        for name in ("elevation", "camera_distances", "fovy"):
            groups = batch[name].reshape(2, 4)
            assert torch.equal(groups, groups[:, :1].expand(2, 4)), name
        azimuth = batch["azimuth"].reshape(2, 4)
        assert azimuth.min() >= -180 and azimuth.max() < 180
        turns = (azimuth - azimuth[:, :1]) % 360
        spaced = torch.tensor([[0.0, 90, 180, 270]] * 2)
        torch.testing.assert_close(turns, spaced, rtol=0, atol=1e-4)
        assert ((azimuth[:, 0] >= 150) & (azimuth[:, 0] <= 180)).all()
        assert batch["elevation"][0] != batch["elevation"][4]


def test_each_epoch_continues_the_stream_and_a_milestone_takes_effect_at_its_step():
    whole, data = batches(module(), 5), module()
    loader, steps = data.train_dataloader(), iter([0, 3])
    data.train_dataset.next_step = lambda: next(steps)
    first, later = ([*itertools.islice(iter(loader), 2)] for _ in range(2))
    for a, b in zip([*whole[:2], *whole[3:]], [*first, *later], strict=True):
        assert torch.equal(a["c2w"], b["c2w"]) and torch.equal(a["fovy"], b["fovy"])
    data = module(height=[16, 32], width=[16, 32], batch_size=[4, 2], resolution_milestones=[3])
    assert [(b["height"], len(b["c2w"])) for b in batches(data, 5)] == [(16, 4)] * 3 + [(32, 2)] * 2


def test_a_pool_repeats_its_cameras_to_the_bit_and_covers_the_circle():
    data = module(train_views=8)
    seen = torch.cat([b["c2w"].flatten(1) for b in batches(data, 20)])
    assert len(seen.unique(dim=0)) == 8
    assert all(sorted((b["azimuth"] // 90).tolist()) == [-2, -1, 0, 1] for b in batches(data, 5))
    data = module(train_views=50, batch_size=3)
    for row in batches(data, 5):
        shown = [data.train_dataset.pool.azimuth.tolist().index(a) for a in row["azimuth"].tolist()]
        batch = orbit_batch(data.train_dataset.pool.rows(torch.tensor(shown)), 32, 48)
        assert batch.keys() == row.keys()
        for name in batch.keys() - {"light_positions", "height", "width"}:
            assert torch.equal(row[name], batch[name]), name


@pytest.mark.parametrize(
    "wrong, named",
    [
        ({"elevation_range": [60, -10]}, "elevation_range"),
        ({"camera_distance_range": [0, 1]}, "camera_distance_range"),
        ({"fovy_range": [40, 190]}, "fovy_range"),
        ({"height": [16, 32]}, "height"),
        ({"width": 0}, "width"),
        ({"train_views": -1}, "train_views"),
        ({"n_view": 3}, "batch_size: expected multiples of n_view=3, got 4"),
        ({"n_view": 2, "train_views": 8}, "train_views: a fixed pool of views has no groups"),
    ],
)
def test_a_wrong_value_is_named(wrong, named):
    refused(named, module, **wrong)
