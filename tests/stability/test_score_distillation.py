"""A4: scores that aren't finite, mixed precision, schedules, resuming, cameras, and whole runs."""

import csv
import math
import random

import numpy as np
import pytest
import torch
from lightning.pytorch.plugins import MixedPrecision

from tests.stability.backends import slow
from tests.stability.report import RESULTS, row
from tests.stability.scenes import CorruptedScore, orbit, score_gradient, seeded, started
from tests.stability.small_runs import EVERY_STEP, Ended, launch, refused, require_equal_ends
from threestudio_gaussiandreamer import cameras
from threestudio_gaussiandreamer.cameras import Orbit
from threestudio_gaussiandreamer.core.devices import HostCopy
from threestudio_gaussiandreamer.core.errors import UserError
from threestudio_gaussiandreamer.diffusion import sds
from threestudio_gaussiandreamer.host import C, find
from threestudio_gaussiandreamer.launch import run
from threestudio_gaussiandreamer.launch.config_check import check_part
from threestudio_gaussiandreamer.meshes.load import load_mesh
from threestudio_gaussiandreamer.meshes.raycast import MeshCaster, over_background
from threestudio_gaussiandreamer.metrics import psnr
from threestudio_gaussiandreamer.splatting import rasterize
from threestudio_gaussiandreamer.training.data import TrainCameras, orbit_batch
from threestudio_gaussiandreamer.training.held_out import EvaluationConfig, HeldOut
from threestudio_gaussiandreamer.training.system import GaussianDreamerSystem


def gradient(corrupted):
    guidance = CorruptedScore({"guidance_scale": 1.0})
    guidance.corrupted = {0: corrupted}
    return score_gradient(guidance, torch.rand(4, 8, 8, 3, generator=seeded()))


@row("A4", "fp16 overflow in VAE/UNet")
@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("items", [(0,), (1, 3), (0, 1, 2, 3)])
def test_bad_items_are_masked_and_the_others_keep_every_bit(items, value, measured):
    whole, _ = gradient({})
    masked, out = gradient(dict.fromkeys(items, value))
    assert out["bad_items"] == len(items) and out["loss_sds"].isfinite()
    assert (masked[list(items)] == 0).all()
    others = [i for i in range(4) if i not in items]
    changed = (masked[others] != whole[others]).sum()
    measured(changed, what="changed numbers of other items", at_most=0)


CORRUPTED = ["system.guidance_type=stability-corrupted-guidance"]
CORRUPTED += ["system.geometry.prior.path=toy.glb"]


def finite_cloud(ended: Ended) -> bool:
    return all(value.isfinite().all() for value in ended.checkpoint()["state_dict"].values())


@row("A4", "fp16 overflow in VAE/UNet")
def test_bad_steps_are_counted_and_the_tenth_in_a_row_ends_the_run(tmp_path, monkeypatch, measured):
    """One bad item in steps 1 and 3, then both from step 5 on: steps 5 to 14 are ten in a row."""
    both = {step: {0: math.nan, 1: math.nan} for step in range(5, 50)}
    monkeypatch.setattr(CorruptedScore, "corrupted", {1: {0: math.nan}, 3: {1: math.inf}} | both)
    steps = "trainer.max_steps=50", "checkpoint.every_n_train_steps=14"
    words = ["NaN or infinity in 10 steps in a row (step 14"]
    ended = refused(tmp_path, *CORRUPTED, *steps, words=words)
    logged = ended.logged("train/bad_items")
    assert finite_cloud(ended) and logged[:6] == [0, 1, 0, 1, 0, 2], logged
    measured("counted in the log; named error after 10")


@pytest.mark.slow
@row("A4", "fp16 overflow in VAE/UNet")
@pytest.mark.parametrize("every, steps", [(14, 14), (100, 16)], ids=["checkpoint", "end"])
def test_bad_steps_end_the_run_also_if_they_are_known_late(
    tmp_path, monkeypatch, measured, every, steps
):
    """As on a GPU, where numbers are read when they have arrived: here not before they must be."""
    monkeypatch.setattr(HostCopy, "ready", lambda copy: False)
    bad = {step: {0: math.nan} for step in range(3, 50)}
    monkeypatch.setattr(CorruptedScore, "corrupted", bad)
    options = ["trainer.max_steps=16", f"checkpoint.every_n_train_steps={every}"]
    words = ["NaN or infinity in 10 steps in a row (step 12"]
    logged = refused(tmp_path, *CORRUPTED, *options, words=words).logged("train/bad_items")
    assert logged == [0] * 3 + [1] * (steps - 3), logged
    measured("named error, and all steps in the log")


def scaled_run(folder, monkeypatch, scale, *options) -> Ended:
    """Run with Lightning's 16-mixed and this loss scale, for which a CPU needs a scaler."""
    plugin = MixedPrecision("16-mixed", "cpu", scaler=torch.amp.GradScaler("cpu", init_scale=scale))
    build = run.build

    def with_scaler(section, owner, arguments):
        arguments = {name: value for name, value in arguments.items() if name != "precision"}
        return build(section, owner, arguments | {"plugins": [*arguments["plugins"], plugin]})

    with monkeypatch.context() as patch:
        patch.setattr(run, "build", with_scaler)
        return launch(folder, *options)


@pytest.mark.slow
@row("A4", "GradScaler")
@pytest.mark.parametrize("scale", [2.0**16, 2.0**24])
def test_any_loss_scale_trains_the_same_bits_as_float32(
    scale, whole, tmp_path, monkeypatch, measured
):
    """Powers of two are exact: a difference could only come from half precision."""
    ended = scaled_run(tmp_path, monkeypatch, scale, *EVERY_STEP)
    require_equal_ends(measured, whole, ended, "different from float32")


@row("A4", "GradScaler")
def test_steps_that_are_skipped_are_counted_and_reported(tmp_path, monkeypatch, measured):
    """At a loss scale of 2^127 gradients overflow until it was halved twice."""
    options = "trainer.max_steps=5", "system.geometry.densify.enabled=true"
    ended = scaled_run(tmp_path, monkeypatch, 2.0**127, *options)
    assert finite_cloud(ended)
    checkpoint = ended.checkpoint()
    skipped = checkpoint["global_step"] - int(checkpoint["optimizer_states"][0]["state"][0]["step"])
    assert skipped >= 2 and ended.err.count("gradients overflowed at the loss scale") == skipped
    uncounted = abs(ended.logged("train/skipped_steps")[-1] - skipped)
    measured(uncounted, "skipped steps", what="not counted", at_most=0)


@row("A4", "Clip schedule")
def test_the_clip_at_its_knots(measured):
    schedules = {
        (0, 1.5, 2.0, 1000): {0: 1.5, 500: 1.75, 1000: 2.0, 2000: 2.0},
        (1.5, 2.0, 1000): {0: 1.5, 500: 1.75, 1000: 2.0},
        (0, 1.0, 2.0, 10, 0.5, 20): {0: 1.0, 5: 1.5, 10: 2.0, 15: 1.25, 20: 0.5, 30: 0.5},
        (500, 0.98, 0.55, 501): {499: 0.98, 500: 0.98, 501: 0.55},
    }
    rows = ((knots, *pair) for knots, values in schedules.items() for pair in values.items())
    wrong = [abs(C(list(knots), 0, step) - value) for knots, step, value in rows]
    by_epoch = {0: 1.5, 5: 1.75, 10: 2.0}.items()
    wrong += [abs(C([0, 1.5, 2.0, 10.0], epoch, 99_999) - value) for epoch, value in by_epoch]
    guidance = CorruptedScore({"grad_clip": [0, 1.5, 2.0, 1000]})
    for step, value in schedules[0, 1.5, 2.0, 1000].items():
        guidance.update_step(0, step)
        wrong.append(abs(guidance.grad_clip - value))
    measured(max(wrong), what="error", at_most=0)


@row("A4", "Clip schedule")
def test_an_invalid_clip_schedule_is_refused_when_it_is_read(measured):
    for knots in (
        [0, 1.5, 2.0, 0], [5, 1.5, 2.0, 5], [9, 1.5, 2.0, 5], [1.5, 2.0, 0], [0, 1, 2, 3, 4], [1],
        [], "1.5", [0, 1, math.nan, 9], [0, 1, 2, 10, 3, 10], [0, 1.0, 2.0, 10, 3.0, 20.5],
        [0, -1.0, 2.0, 9], -1, True, {"a": 1},
    ):  # fmt: skip
        with pytest.raises(UserError, match="system.guidance.grad_clip"):
            check_part("system.guidance", "stability-corrupted-guidance", {"grad_clip": knots})
    measured("bad lists refused by name")


@row("A4", "t edges")
@pytest.mark.parametrize("percents", [(0.0, 0.0), (0.0, 1.0), (1.0, 1.0), (0.02, 0.98)])
def test_timesteps_stay_inside_the_table(percents, measured):
    steps = (sds.timesteps(50, *sds.step_range(*percents), seed=0, step=i) for i in range(40))
    drawn = torch.cat(list(steps))
    measured(((drawn < 1) | (drawn > 999)).sum(), "of 2000 outside [1, 999]", at_most=0)


@row("A4", "t edges")
def test_a_range_that_is_empty_after_annealing_is_named(measured):
    """Before any work, not at the step at which the two schedules cross."""
    crossing = {"min_step_percent": 0.6, "max_step_percent": [500, 0.98, 0.55, 501]}
    with pytest.raises(UserError, match="min_step_percent: 0.6 is above max_step_percent, 0.55"):
        check_part("system.guidance", "stability-corrupted-guidance", crossing)
    measured("named error")


@row("A4", "t edges")
@pytest.mark.parametrize("name", sorted(sds.WEIGHTS))
def test_the_gradient_at_the_first_and_last_timestep_is_finite(name, measured):
    """Records which share of each weighting falls on the first tenth of the timesteps."""
    abar, t = sds.sd_alphas_cumprod(), torch.tensor([1, 500, 999])
    pull = sds.WEIGHTS[name](abar) * (abar / (1 - abar)).sqrt()
    x, noise = torch.randn(2, 3, 4, 8, 8, generator=seeded())
    z = sds.diffuse(x, noise, abar[t])
    values = z, sds.predict_x0(z, noise, abar[t]), sds.WEIGHTS[name](abar[t])
    assert all(value.isfinite().all() for value in values)
    share = 100 * pull[20:100].sum() / pull[20:981].sum()
    measured(share, "%", what=f"{name}: weight of t < 100 among 20 to 980")


NINE = ["checkpoint.every_n_train_steps=1", "trainer.max_steps=9"]
EDGE = [
    *NINE,
    "system.guidance.max_step_percent=[5,0.98,0.55,6]", "system.guidance.grad_clip=[5,0.5,1.0,6]",
    "data.height=[16,24]", "data.width=[16,24]", "data.resolution_milestones=[5]",
    "system.geometry.lr_means=[5,1e-2,1e-3,6]", "data.train_views=0",
    "system.loss.lambda_sds=[5,1.0,0.5,6]",
]  # fmt: skip
DENSIFYING = [
    *NINE,
    "system.geometry.densify={enabled: true, start: 1, every: 2, stop: 9, grad_threshold: 1e-4}",
    "data.train_views=0",
]  # fmt: skip


def require_same_when_resumed(measured, folder, run: Ended, step: int, *options) -> None:
    """Resume, in another folder, from the checkpoint that the run wrote at ``step``."""
    ended = launch(folder, *options, f"resume={run.at_step(step)}")
    require_equal_ends(measured, run, ended, "different")


@pytest.fixture(scope="module")
def over_the_edge(tmp_path_factory) -> Ended:
    ended = launch(tmp_path_factory.mktemp("edge"), *EDGE)
    assert [ended.logged("train/max_step")[step] for step in (4, 5, 6)] == [980, 980, 550]
    return ended


@row("A4", "Resume mid-schedule")
@pytest.mark.slow
@pytest.mark.parametrize("step", [4, 5, 6])
def test_resumed_at_the_edge_of_every_schedule(step, over_the_edge, tmp_path, measured):
    """All jump from step 5 to step 6, like the paper's from 500 to 501."""
    require_same_when_resumed(measured, tmp_path, over_the_edge, step, *EDGE)


@pytest.fixture(scope="module")
def random_streams(tmp_path_factory) -> Ended:
    """A run that draws everything at every step."""
    ended = launch(tmp_path_factory.mktemp("streams"), *DENSIFYING)
    assert len(ended.checkpoint()["state_dict"]["geometry.means"]) > 130
    return ended


@row("A4", "RNG")
@pytest.mark.slow
@pytest.mark.parametrize("step", [1, 4, 8])
def test_stopped_and_resumed_anywhere(step, random_streams, tmp_path, measured):
    require_same_when_resumed(measured, tmp_path, random_streams, step, *DENSIFYING)


@pytest.mark.slow
@row("A4", "RNG")
@pytest.mark.parametrize("views, every", [(1, 3), (3, 1)])
def test_validation_changes_nothing(views, every, random_streams, tmp_path, monkeypatch, measured):
    """Neither the views nor what they draw from the process's own generators matters."""
    looked, seen = GaussianDreamerSystem.validation_step, []

    def greedy(self, batch, batch_idx):
        seen.append((torch.rand(7), np.random.random(5), random.random()))
        return looked(self, batch, batch_idx)

    monkeypatch.setattr(GaussianDreamerSystem, "validation_step", greedy)
    validated = ["trainer.limit_val_batches=1.0", f"trainer.val_check_interval={every}"]
    validated += [f"data.n_val_views={views}"]
    ended = launch(tmp_path, *DENSIFYING, *validated)
    assert len(seen) == views * (9 // every)
    require_equal_ends(measured, random_streams, ended, "different")


# configs/demo.yaml's schedules span the whole run; a short one gets them in proportion
RATES = {
    "means": (4e-4, 2e-5), "scales": (6e-2, 1e-3), "quats": (6e-2, 2e-3),
    "opacities": (1e-1, 5e-3), "sh": (1e-1, 2e-3),
}  # fmt: skip
POINTS = ["system.geometry.prior.num_points=1500"]
LATENT = [f"system.guidance.{x}" for x in ("space=latent", "latent_size=16", "bank_views=100")]
STRONG = [*LATENT, "system.guidance.guidance_scale=101.0"]
BLIND = [
    *LATENT, "system.guidance.mode=view-agnostic", "data.camera_distance_range=[2.5,2.5]",
    "data.fovy_range=[50,50]", "system.guidance.bank_distance_range=[2.5,2.5]",
    "system.guidance.bank_fovy_range=[50,50]",
]  # fmt: skip
RANDOM_START = [f"system.geometry.prior{x}" for x in ("_type=random-prior", ".shape=sphere")]


def trained(folder, steps, size, *options) -> Ended:
    """Train long enough for a result, with timesteps up to 0.55 after five twelfths."""
    middle = steps * 5 // 12
    return launch(
        folder,
        *(f"system.geometry.lr_{name}=[0,{a},{b},{steps}]" for name, (a, b) in RATES.items()),
        *(f"data.{side}={size}" for side in ("width", "height")),
        *(f"system.evaluation.{option}" for option in ("size=48", "views=8", "supersample=2")),
        "data.train_views=40", f"trainer.max_steps={steps}", "trainer.log_every_n_steps=50",
        f"system.guidance.max_step_percent=[{middle},0.98,0.55,{middle + 1}]",
        "system.geometry.lr_means_unit=world", *options,
    )  # fmt: skip


@pytest.mark.slow
@row("A4", "Guidance 100: over-saturation")
def test_annealing_helps_and_clipping_helps_more(tmp_path, measured):
    """The exact score of the toy in a latent; over-saturation is measured out of gamut."""
    variants = {"as it is": [*STRONG, "system.guidance.max_step_percent=0.98"], "annealed": STRONG}
    variants["annealed and clipped"] = [*STRONG, "system.guidance.grad_clip=[0,1.5,2.0,150]"]
    variants["no guidance"] = LATENT
    dB, outside = [], []
    for name, options in variants.items():
        options = ["data.batch_size=4", "system.geometry.bound_colors=false", *POINTS, *options]
        ended = trained(tmp_path / name.replace(" ", "-"), 150, 48, *options)
        dB.append(ended.metrics()["result"]["psnr"])
        outside.append(100 * ended.metrics()["result"]["out_of_gamut"])
        measured(dB[-1], "dB", what=name if name == "no guidance" else f"guidance 100 {name}")
        measured(outside[-1], "%", what=f"out of gamut {name}")
    # 15.1, 16.6, 19.1 and 23.1 dB here
    assert dB[0] + 0.5 < dB[1] and dB[1] + 1 < dB[2] and dB[2] + 1 < dB[3], dB
    assert outside[0] > outside[2] > outside[3]


@pytest.mark.slow
@row("A4", "Janus")
def test_a_prior_prevents_multiple_faces_and_a_random_start_does_not(tmp_path, measured):
    """A view-blind score and short runs, measured with the package's metric."""
    for name, start, bound in (
        ("prior", POINTS, {"at_most": 5}),
        ("random start", [*POINTS, *RANDOM_START], {"at_least": 50}),
    ):
        ended = trained(tmp_path / name.replace(" ", "-"), 100, 48, *BLIND, *start)
        rate = 100 * ended.metrics()["result"]["multi_face"]
        measured(rate, "% multi-face", what=name, **bound)


@row("A4", "Janus")
def test_the_table_of_five_seeds(measured):
    """Runs of 1200 steps at 128 pixels, by ``benchmarks.quality.ablations --table faces``."""
    lines = RESULTS.with_name("faces.csv").read_text().splitlines()
    table = csv.DictReader(line for line in lines if not line.startswith("#"))
    rows = {row["variant"]: row for row in table}
    assert all(int(row["seeds"]) >= 5 for row in rows.values())
    for name, bound in (("prior", {"at_most": 5}), ("random start", {"at_least": 50})):
        rate = 100 * float(rows[name]["multi_face"])
        measured(rate, "% multi-face", what=f"{name}, five seeds of 1200 steps", **bound)


@pytest.mark.slow
@row("A4", "Colour drift, background shortcut")
def test_the_cloud_does_not_depend_on_the_background(tmp_path, measured):
    """Only the alpha error differs, mostly at the outline: below 1 dB at the end of the demo's
    schedules, more after three fifths of them, with a dilation of 0.3, or for training on black.
    """
    options = "system.geometry.prior.num_points=3000", "data.train_views=60"
    state = trained(tmp_path, 500, 96, *options).checkpoint()["state_dict"]
    cloud, own = find("gaussiandreamer-cloud")({}), "geometry."
    cloud.load_state_dict({k.removeprefix(own): v for k, v in state.items() if k.startswith(own)})
    held_out = HeldOut(EvaluationConfig(views=8, size=96), MeshCaster(load_mesh("toy.glb")))
    colors = (torch.tensor(c) for c in ((0.0, 0.0, 0.0), (1.0, 1.0, 1.0), (1.0, 0.0, 1.0)))
    images, scores = [], []
    as_demo = {"eps2d": 0.03, "antialias": True}
    for color in colors:
        view = held_out.orbit.c2w, held_out.orbit.fovy, 96
        with torch.no_grad():
            images.append(rendered(cloud, *view, background=color, **as_demo))
        truth = over_background(held_out.truth, color)
        scores.append(float(psnr(images[-1].clamp(0, 1), truth)))
    alpha = 1 - (images[1] - images[0]).mean(-1)
    measured((alpha - held_out.truth[..., 3]).abs().mean(), what="alpha error", at_most=0.02)
    assert min(scores) > 25
    measured(max(scores) - min(scores), "dB", what="spread over three backgrounds", at_most=1.0)


def rendered(cloud, c2w, fovy, size, **options):
    """Return the images (B, size, size, 3) of a cloud."""
    viewmats, Ks = cameras.to_opencv(c2w, fovy, size, size)
    colors = cloud.colors(c2w[:, :3, 3])
    gaussians = cloud.means, cloud.quats, cloud.scales(), cloud.opacities(), colors
    return rasterize(*gaussians, viewmats, Ks, size, size, **options).image


EXTREME = {"above": (90.0, 0.0, 2.5, 50.0), "below": (-90.0, 45.0, 2.5, 50.0)}
EXTREME |= {"inside": (0.0, 0.0, 0.1, 50.0), "fov 1": (0.0, 10.0, 2.5, 1.0)}
EXTREME |= {"fov 170": (15.0, 200.0, 2.5, 170.0)}
ORDINARY = (15.0, 30.0, 2.5, 50.0)


def pictures_and_gradients(cloud, c2w, fovy):
    """Return the first, ordinary view's image and the cloud's gradients of a loss on all views."""
    cloud.zero_grad()
    image = rendered(cloud, c2w, fovy, 48, background=torch.ones(3))
    image.square().sum().backward()
    assert image.isfinite().all()
    parameters = cloud.parameters_by_name().items()
    return image[0].detach(), {name: value.grad for name, value in parameters if value.numel()}


@row("A4", "Extreme cameras in a batch")
@pytest.mark.parametrize("name", EXTREME)
def test_an_extreme_camera_does_not_affect_the_other_views(name, measured):
    cloud, (view, odd) = started(), (orbit(ORDINARY), orbit(ORDINARY, EXTREME[name]))
    alone, _ = pictures_and_gradients(cloud, view.c2w, view.fovy)
    beside, gradients = pictures_and_gradients(cloud, odd.c2w, odd.fovy)
    assert all(grad.isfinite().all() for grad in gradients.values())
    measured((alone != beside).sum(), "numbers", what="changed in the other view", at_most=0)


def with_cameras(monkeypatch, change) -> None:
    """Replace the cameras of each batch by ``change(orbit)``, an Orbit and its c2w matrices."""
    collate = TrainCameras.collate

    def changed(self, step):
        batch = collate(self, step)
        view = Orbit(*(batch[n] for n in ("elevation", "azimuth", "camera_distances", "fovy")))
        view, c2w = change(view)
        made = orbit_batch(view, batch["height"], batch["width"])
        return made | {"c2w": c2w, "light_positions": batch["light_positions"]}

    monkeypatch.setattr(TrainCameras, "collate", changed)


@pytest.mark.slow
@row("A4", "Extreme cameras in a batch")
def test_training_with_extreme_cameras_logs_each_items_gradient(tmp_path, monkeypatch, measured):
    """The whole step, on a batch of an ordinary camera and all extreme ones."""
    views, ordinary = [ORDINARY, *EXTREME.values()], []
    options = ["trainer.max_steps=3", f"data.batch_size={len(views)}"]
    for name, batch in (("ordinary", [ORDINARY] * len(views)), ("extreme", views)):
        with monkeypatch.context() as patch:
            chosen = orbit(*batch)
            with_cameras(patch, lambda _, chosen=chosen: (chosen, chosen.c2w))
            ended = launch(tmp_path / name, *options)
        ordinary.append(ended.logged("train/grad_norm_0")[0])
    assert finite_cloud(ended)
    norms = [ended.logged(f"train/grad_norm_{i}") for i in range(len(views))]
    assert all(len(norm) == 3 and np.isfinite(norm).all() for norm in norms)
    changed = abs(ordinary[0] - ordinary[1])
    measured(changed, what="change of the ordinary item's gradient norm", at_most=0)


@row("A4", "Empty view in a batch")
@pytest.mark.parametrize("empty", [(1,), *slow((0, 1))], ids=str)
def test_an_empty_view_in_a_batch(empty, tmp_path, monkeypatch, measured):
    def turned_around(view):
        c2w = view.c2w.clone()
        c2w[list(empty), :3, 0] *= -1
        c2w[list(empty), :3, 2] *= -1
        return view, c2w

    with_cameras(monkeypatch, turned_around)
    rules = "system.geometry.densify={enabled: true, start: 1, every: 1, stop: 9}"
    assert finite_cloud(launch(tmp_path, "trainer.max_steps=3", rules))
    measured("all steps succeed")
