"""Score distillation with extreme and degenerate cameras."""

import math

import numpy as np
import pytest
import torch

from tests.stability.rows import row
from tests.stability.score_distillation_cases import orbit
from tests.stability.small_runs import launch
from threestudio_gaussiandreamer import cameras, register_parts
from threestudio_gaussiandreamer.cameras import Orbit
from threestudio_gaussiandreamer.host import find
from threestudio_gaussiandreamer.splatting import rasterize
from threestudio_gaussiandreamer.training.data import TrainCameras, make_batch

register_parts()


# ---- cameras -------------------------------------------------------------------------------------

EXTREME = {
    "above": (90.0, 0.0, 2.5, 50.0),
    "below": (-90.0, 45.0, 2.5, 50.0),
    "inside": (0.0, 0.0, 0.1, 50.0),
    "fov 1": (0.0, 10.0, 2.5, 1.0),
    "fov 170": (15.0, 200.0, 2.5, 170.0),
}


ORDINARY = (15.0, 30.0, 2.5, 50.0)


def ball_cloud():
    rng = np.random.default_rng(0)
    points = rng.normal(size=(300, 3))
    points *= 0.7 / np.linalg.norm(points, axis=1, keepdims=True)
    cloud = find("gaussiandreamer-cloud")({"grow": {"enabled": False}})
    cloud.start_from(
        type(
            "Points",
            (),
            {"points": points.astype(np.float32), "colors": rng.random((300, 3), np.float32)},
        )
    )
    return cloud


def pictures_and_gradients(cloud, c2w, fovy):
    """Return the first, ordinary view's image and the cloud's gradients of a loss on all views."""
    viewmats, Ks = cameras.to_opencv(c2w, fovy, 48, 48)
    cloud.zero_grad()
    colors = cloud.colors(c2w[:, :3, 3])
    gaussians = cloud.means, cloud.quats, cloud.scales(), cloud.opacities(), colors
    image = rasterize(*gaussians, viewmats, Ks, 48, 48, background=torch.ones(3)).image
    image.square().sum().backward()
    assert image.isfinite().all()
    return image[0].detach(), {
        name: parameter.grad
        for name, parameter in cloud.parameters_by_name().items()
        if parameter.numel()
    }


@row("A4", "Extreme cameras in a batch")
@pytest.mark.parametrize("name", EXTREME)
def test_an_extreme_camera_does_not_affect_the_other_views(name, measured):
    cloud, (view, odd) = ball_cloud(), (orbit(ORDINARY), orbit(ORDINARY, EXTREME[name]))
    alone, _ = pictures_and_gradients(cloud, view.c2w, view.fovy)
    beside, gradients = pictures_and_gradients(cloud, odd.c2w, odd.fovy)
    assert all(grad.isfinite().all() for grad in gradients.values())
    measured((alone != beside).sum(), "numbers", what="changed in the other view", at_most=0)


@row("A4", "Extreme cameras in a batch")
@pytest.mark.parametrize("what", ["NaN", "infinite", "zero", "in the centre it looks at"])
def test_a_degenerate_camera_affects_only_its_own_item(what, measured):
    """Beyond the row: an invalid camera. Its image is the background and it has no gradient."""
    cloud, view = ball_cloud(), orbit(ORDINARY)
    alone, expected = pictures_and_gradients(cloud, view.c2w, view.fovy)
    at_center = cameras.look_at(
        torch.zeros(1, 3), torch.zeros(1, 3), torch.tensor([[0.0, 0.0, 1.0]])
    )
    bad = {
        "NaN": torch.full((1, 4, 4), math.nan),
        "infinite": torch.full((1, 4, 4), math.inf),
        "zero": torch.zeros(1, 4, 4),
    }
    c2w = torch.cat([view.c2w, bad.get(what, at_center)])
    beside, gradients = pictures_and_gradients(cloud, c2w, view.fovy.repeat(2))
    batch = make_batch(
        orbit(ORDINARY, ORDINARY), c2w, c2w[:, :3, 3], 48, 48
    )  # one camera's inverse doesn't affect the others
    assert batch["mvp_mtx"][0].equal(
        make_batch(view, view.c2w, view.c2w[:, :3, 3], 48, 48)["mvp_mtx"][0]
    )
    assert torch.linalg.det(at_center[0]).sub(1).abs() < 1e-6
    changed = (alone != beside).sum()
    if what in bad:
        changed += sum((gradients[name] != expected[name]).sum() for name in gradients)
    measured(changed, "numbers", what="changed by a degenerate camera", at_most=0)


def with_cameras(monkeypatch, change) -> None:
    """Replace the cameras of each training batch by ``change(step, batch)``, an :class:`Orbit` or
    c2w matrices.
    """
    collate = TrainCameras.collate

    def changed(self, step):
        batch = collate(self, step)
        odd = change(step, batch)
        view = (
            odd
            if isinstance(odd, Orbit)
            else Orbit(*(batch[n] for n in ("elevation", "azimuth", "camera_distances", "fovy")))
        )
        c2w = odd.c2w if isinstance(odd, Orbit) else odd
        return make_batch(view, c2w, batch["light_positions"], batch["height"], batch["width"])

    monkeypatch.setattr(TrainCameras, "collate", changed)


@row("A4", "Extreme cameras in a batch")
def test_training_with_extreme_cameras_logs_each_items_gradient(tmp_path, monkeypatch, measured):
    """The whole step, with ray-cast targets, on a batch of an ordinary camera and all
    extreme ones.
    """
    views = [ORDINARY, *EXTREME.values()]
    options = ["trainer.max_steps=3", f"data.batch_size={len(views)}"]
    ordinary = []
    for name, batch in (("ordinary", [ORDINARY] * len(views)), ("extreme", views)):
        with monkeypatch.context() as patch:
            with_cameras(patch, lambda step, _, batch=batch: orbit(*batch))
            ended = launch(tmp_path / name, *options)
        assert ended.code == 0, ended.err
        ordinary.append(ended.logged("train/grad_norm_0")[0])
    assert all(value.isfinite().all() for value in ended.checkpoint()["state_dict"].values())
    norms = [ended.logged(f"train/grad_norm_{i}") for i in range(len(views))]
    assert all(len(norm) == 3 and np.isfinite(norm).all() for norm in norms)
    measured(
        abs(ordinary[0] - ordinary[1]),
        what="change of the ordinary item's gradient norm",
        at_most=0,
    )


@row("A4", "Empty view in a batch")
@pytest.mark.parametrize("empty", [(1,), (0, 1)], ids=["one", "all"])
def test_an_empty_view_in_a_batch(empty, tmp_path, monkeypatch, measured):
    def turned_around(step, batch):
        c2w = batch["c2w"].clone()
        c2w[list(empty), :3, 0] *= -1
        c2w[list(empty), :3, 2] *= -1
        return c2w

    with_cameras(monkeypatch, turned_around)
    ended = launch(
        tmp_path,
        "trainer.max_steps=3",
        "system.geometry.densify.enabled=true",
        "system.geometry.densify.start=1",
        "system.geometry.densify.every=1",
        "system.geometry.densify.stop=9",
    )
    assert ended.code == 0, ended.err
    assert all(value.isfinite().all() for value in ended.checkpoint()["state_dict"].values())
    measured("all steps succeed")
