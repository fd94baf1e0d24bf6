"""The stage of training towards pictures of the 2D model."""

import csv
from types import SimpleNamespace

import pytest
import torch

from tests.training.runs import cloud_of, launch, mocked_config, run_folder, same
from threestudio_gaussiandreamer.core.errors import UserError
from threestudio_gaussiandreamer.launch.experiment import main
from threestudio_gaussiandreamer.training.geometry import LEARNING_RATES
from threestudio_gaussiandreamer.training.image_targets import (
    SHAPES,
    ImageTargets,
    ImageTargetsConfig,
    check_image_targets,
)

STAGE = [
    f"system.image_targets.{option}"
    for option in ("start=3", "stop=6", "views=5", "num_inference_steps=2", "camera_distance=2.7")
]
BATCH = {"c2w": torch.eye(4)[None], "height": 8, "width": 6}


def stage(**options):
    return ImageTargets(ImageTargetsConfig(**{"start": 3, "stop": 6, **options}))


def logged(folder):
    """Return what each step logged."""
    (path,) = run_folder(folder).glob("csv_logs/version_*/metrics.csv")
    with open(path, newline="") as file:
        return {int(row["step"]): row for row in csv.DictReader(file) if row["train/evaluations"]}


def test_its_cameras_go_round_the_object_from_the_front():
    own = stage(views=4, elevation_deg=10.0, camera_distance=2.0).batch(BATCH, 3)
    assert own["azimuth"].tolist() == [0, 90, -180, -90] and (own["height"], own["width"]) == (8, 6)
    positions = own["c2w"][:, :3, 3]
    assert torch.allclose(positions.norm(dim=1), torch.tensor(2.0))
    assert positions[0, 0] > 1.9 and positions[2, 0] < -1.9  # the front is +x


def test_other_steps_keep_the_batch_and_the_losses():
    weights = {"sds": 1.0, "tv": 2.0}
    for step in (0, 2, 6, 100):
        assert stage().batch(BATCH, step) is BATCH
        assert stage().loss_weights(weights, step) is weights
    assert stage(weight=3.0).loss_weights(weights, 5) == {"tv": 2.0, "image_targets": 3.0}
    assert not any(ImageTargets(ImageTargetsConfig()).is_active(step) for step in range(10))


def test_a_run_has_the_stage_and_then_goes_on(tmp_path, painted_box):
    """Against an exact score: its pictures are those of the object."""
    options = [*STAGE, "system.loss.lambda_tv=1", "trainer.max_steps=33"]
    options += ["system.image_targets.stop=30"]
    assert launch(tmp_path, painted_box, *options) == 0
    rows = logged(tmp_path)
    inside = {step for step, row in rows.items() if row.get("train/loss_image_targets")}
    assert inside == set(range(3, 30))
    assert not any(rows[step]["train/loss_sds"] for step in inside)
    assert float(rows[3]["train/evaluations"]) == 10 and float(rows[4]["train/evaluations"]) == 0
    losses = [float(rows[step]["train/loss_image_targets"]) for step in (3, 29)]
    assert 0 < losses[1] < losses[0]
    last = cloud_of(run_folder(tmp_path) / "ckpts" / "last.ckpt")
    assert not any(name.startswith("image_targets") for name in last)


@pytest.mark.parametrize("colors_only", [True, False])
def test_shapes_stay_as_they_are_where_only_colors_are_trained(tmp_path, painted_box, colors_only):
    options = [*STAGE, f"system.image_targets.colors_only={colors_only}"]
    steps = ["checkpoint.every_n_train_steps=1", "checkpoint.save_top_k=-1", "trainer.max_steps=6"]
    assert launch(tmp_path, painted_box, *options, *steps) == 0
    folder = run_folder(tmp_path) / "ckpts"
    start, end = (cloud_of(next(folder.glob(f"*step={step}.ckpt"))) for step in (3, 6))
    moved = {name for name in start if not torch.equal(start[name], end[name])}
    moved &= {f"geometry.{name}" for name in LEARNING_RATES}
    shapes = {"geometry.means", "geometry.quats", "geometry.log_scales", "geometry.logit_opacities"}
    assert moved - shapes == {"geometry.sh0"} and moved & shapes == (
        set() if colors_only else shapes
    )


def test_shapes_go_on_after_the_stage_as_if_it_had_not_been(tmp_path, painted_box):
    """The optimiser's moments of the shapes are those of before."""
    options = [*STAGE, "checkpoint.every_n_train_steps=1", "checkpoint.save_top_k=-1"]
    assert launch(tmp_path, painted_box, *options, "trainer.max_steps=6") == 0
    folder = run_folder(tmp_path) / "ckpts"
    first, last = (
        torch.load(next(folder.glob(f"*step={step}.ckpt")), weights_only=True) for step in (3, 6)
    )
    groups = {
        group["name"]: group["params"] for group in first["optimizer_states"][0]["param_groups"]
    }
    for name, (index,) in groups.items():
        states = [c["optimizer_states"][0]["state"][index] for c in (first, last)]
        assert torch.equal(*(state["exp_avg_sq"] for state in states)) == (name in SHAPES)


def test_a_random_background_stays_that_of_the_pictures(tmp_path, painted_box):
    options = [*STAGE, "system.background.mode=random", "system.image_targets.stop=30"]
    assert launch(tmp_path, painted_box, *options, "trainer.max_steps=31") == 0
    rows = logged(tmp_path)
    losses = [float(rows[step]["train/loss_image_targets"]) for step in range(3, 30)]
    rises = [later - sooner for sooner, later in zip(losses[5:], losses[6:], strict=False)]
    assert losses[-1] < losses[0] and max(rises) < 0.02 * losses[0]


def test_pictures_are_redrawn_for_another_number_of_views_on_resume(tmp_path, painted_box, capsys):
    options = [*STAGE, "checkpoint.every_n_train_steps=1"]
    assert launch(tmp_path, painted_box, *options, "trainer.max_steps=4") == 0
    last = run_folder(tmp_path) / "ckpts" / "last.ckpt"
    changed = [*options, "system.image_targets.views=3", "trainer.max_steps=8", f"resume={last}"]
    capsys.readouterr()
    assert launch(tmp_path, painted_box, *changed) == 0
    assert "training towards 3 pictures" in capsys.readouterr().err


def test_the_resolution_may_change_within_the_stage(tmp_path, painted_box):
    sizes = ["data.height=[24,32]", "data.width=[24,32]", "data.resolution_milestones=[4]"]
    assert launch(tmp_path, painted_box, *STAGE, *sizes, "trainer.max_steps=7") == 0


def test_a_stage_that_is_not_over_at_the_end_is_reported():
    assert "isn't over at step 5" in stage().schedule_problem(0, 5)
    for start, stop in ((0, 6), (0, 100), (0, -1), (6, 6)):
        assert stage().schedule_problem(start, stop) is None
    assert ImageTargets(ImageTargetsConfig()).schedule_problem(0, 5) is None


def test_models_that_see_several_views_together_get_as_many():
    cfg = SimpleNamespace(
        image_targets=ImageTargetsConfig(stop=6, views=3),
        guidance_type="gaussiandreamer-mvdream-guidance",
        guidance={},
    )
    with pytest.raises(UserError, match="image_targets.views: expected 4, .* got 3"):
        check_image_targets(cfg)
    check_image_targets(
        SimpleNamespace(**{**vars(cfg), "image_targets": ImageTargetsConfig(stop=6)})
    )


def test_an_entry_that_is_no_picture_is_dropped():
    own = stage()
    own.load_state_dict({"pictures": "damaged"}, strict=False)
    assert own.pictures is None


def test_a_stopped_run_continues_bit_for_bit(tmp_path, painted_box):
    """Stopped before the stage, within it, and at its end."""
    options = [*STAGE, "checkpoint.every_n_train_steps=1"]

    def train(name, steps, *more):
        assert (
            launch(tmp_path / name, painted_box, *options, f"trainer.max_steps={steps}", *more) == 0
        )
        return run_folder(tmp_path / name) / "ckpts" / "last.ckpt"

    whole = cloud_of(train("whole", 8))
    for stop in (3, 4, 6):
        name = f"stopped at {stop}"
        stopped = train(name, stop)
        assert ("image_targets.pictures" in cloud_of(stopped)) == (stop in (4, 6))
        assert same(whole, cloud_of(train(name, 8, f"resume={stopped}"))), name


def test_a_guidance_without_pictures_is_refused(tmp_path, painted_box, capsys):
    config = mocked_config(tmp_path, painted_box)
    assert main(["--config", str(config), "--train", "--gpu", "cpu", *STAGE]) != 0
    assert "image_targets.stop: test-mock-guidance can't draw pictures" in capsys.readouterr().err


def test_a_stage_that_ends_before_it_begins_is_refused(tmp_path, painted_box, capsys):
    assert launch(tmp_path, painted_box, *STAGE, "system.image_targets.stop=3") != 0
    assert "image_targets.stop: expected more than start (3), got 3" in capsys.readouterr().err
