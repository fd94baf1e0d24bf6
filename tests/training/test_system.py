"""Whole runs of a few steps: with a mocked guidance (copy this one for your own), against a known
truth, killed and resumed.
"""

import csv
import json
import re
import shutil
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml

from threestudio_gaussiandreamer.formats.gaussian_files import read_cloud
from threestudio_gaussiandreamer.formats.ply import read_gaussians
from threestudio_gaussiandreamer.formats.spz import read_spz
from threestudio_gaussiandreamer.gaussians.sh import sh0_to_rgb
from threestudio_gaussiandreamer.guidance.known_truth import MeshTruth
from threestudio_gaussiandreamer.host import BaseObject, register
from threestudio_gaussiandreamer.launch.experiment import main
from threestudio_gaussiandreamer.training import held_out as evaluate
from threestudio_gaussiandreamer.training import system
from threestudio_gaussiandreamer.training.system import GaussianDreamerSystem

CONFIGS = Path(__file__).parents[2] / "configs"
SMALL = [
    "data.width=24", "data.height=24", "data.eval_width=32", "data.eval_height=32",
    "data.n_test_views=3", "data.train_views=12", "system.geometry.prior.num_points=150",
    "system.geometry.prior.color_smoothing=0", "system.geometry.grow.num_candidates=20000",
    "system.geometry.grow.radius=0.05", "system.geometry.grow.max_points=50",
    "system.evaluation.size=24", "system.evaluation.views=6", "trainer.enable_progress_bar=false",
    "trainer.log_every_n_steps=1", "use_timestamp=false", "tag=t",
]  # fmt: skip


@dataclass
class _Config(BaseObject.Config):
    color: tuple = (0.9, 0.2, 0.1)


@register("test-mock-guidance")
class MockGuidance(BaseObject):
    """threestudio's call: pulls every render towards one colour. A score model in your tests looks
    like this.
    """

    Config = _Config

    def __call__(
        self,
        rgb,
        prompt_utils,
        elevation,
        azimuth,
        camera_distances,
        rgb_as_latents=False,
        guidance_eval=False,
        **kwargs,
    ):
        target = torch.tensor(list(self.cfg.color)).expand_as(rgb)
        return {
            "loss_sds": 0.5 * ((rgb - target) ** 2).sum() / len(rgb),
            "grad_norm": (rgb - target).norm().detach(),
            "min_step": 20,
            "max_step": 980,
        }


@pytest.fixture(scope="module")
def painted_box(tmp_path_factory):
    """A box whose six sides have six colours, as a GLB."""
    import trimesh

    box = trimesh.creation.box(extents=(1.0, 1.6, 1.2))
    box = box.subdivide().subdivide()
    sides = np.abs(box.face_normals).argmax(1) * 2 + (box.face_normals.max(1) > 0.5)
    palette = np.array(
        [
            [220, 40, 40],
            [40, 200, 60],
            [50, 80, 220],
            [230, 210, 50],
            [200, 60, 200],
            [60, 210, 210],
        ]
    )
    box.unmerge_vertices()
    box.visual.vertex_colors = np.repeat(palette[sides], 3, axis=0)
    path = tmp_path_factory.mktemp("assets") / "box.glb"
    box.export(path)
    return path


def launch(folder, mesh, *options, stage="--train"):
    overrides = [f"exp_root_dir={folder}", f"system.guidance.mesh={mesh}", *SMALL, *options]
    return main(["--config", str(CONFIGS / "demo.yaml"), stage, "--gpu", "cpu", *overrides])


def trial(folder):
    return Path(folder) / "demo" / "t"


def cloud_of(path):
    return torch.load(path, weights_only=True, map_location="cpu")["state_dict"]


def same(a, b):
    return a.keys() == b.keys() and all(torch.equal(a[k], b[k]) for k in a)


def mocked_config(folder, mesh, **system):
    """The demo's YAML with the mock in the place of its guidance."""
    cfg = yaml.safe_load((CONFIGS / "demo.yaml").read_text())
    cfg["system"] |= {"guidance_type": "test-mock-guidance", "guidance": {}, **system}
    cfg["system"]["geometry"]["prior"]["path"] = str(mesh)
    path = folder / "mocked.yaml"
    path.write_text(yaml.safe_dump(cfg))
    return path


def test_a_run_with_a_mocked_guidance_goes_from_prior_to_files(tmp_path, painted_box):
    overrides = [
        f"exp_root_dir={tmp_path}",
        *SMALL,
        "trainer.max_steps=6",
        "trainer.val_check_interval=3",
    ]
    assert (
        main(
            [
                "--config",
                str(mocked_config(tmp_path, painted_box)),
                "--train",
                "--gpu",
                "cpu",
                *overrides,
            ]
        )
        == 0
    )
    save = trial(tmp_path) / "save"
    assert (save / "it3-0.png").is_file() and (save / "it6-0.png").is_file()
    assert (save / "it6-test.mp4").stat().st_size > 0 and (save / "it6-test" / "2.png").is_file()
    assert len(read_gaussians(save / "it6-export" / "gaussians.ply").means) == 200
    assert (trial(tmp_path) / "ckpts" / "last.ckpt").is_file() and (
        trial(tmp_path) / "cmd.txt"
    ).is_file()


def test_training_against_a_known_truth_improves_on_held_out_views(tmp_path, painted_box, capsys):
    assert (
        launch(tmp_path, painted_box, "trainer.max_steps=60", "trainer.val_check_interval=60") == 0
    )
    metrics = json.loads((trial(tmp_path) / "save" / "metrics.json").read_text())
    assert (
        metrics["result"]["psnr"] > metrics["prior"]["psnr"] + 1.5
    )  # 60 steps at 24 pixels give about 4 dB
    assert metrics["result"]["step"] == 60 and metrics["result"]["gaussians"] == 200
    (exported,) = (trial(tmp_path) / "save").glob("it60-export/gaussians.ply")
    colors = sh0_to_rgb(read_gaussians(exported).sh[:, 0])
    assert (
        colors.min() > -1e-6 and colors.max() < 1 + 1e-6 and metrics["result"]["out_of_gamut"] == 0
    )
    printed = capsys.readouterr().out
    assert (
        "compare.png" in printed
        and "test.mp4" in printed
        and ".ply" in printed
        and "multi-face" in printed
    )
    rows = list(csv.DictReader(open(trial(tmp_path) / "csv_logs" / "version_0" / "metrics.csv")))
    assert {"loss", "gaussians", "dB", "train/loss_sds", "train/grad_norm"} <= set(rows[0])
    events = tensorboard_events(trial(tmp_path))
    logged = [(event.step, round(event.value, 3)) for event in events.Scalars("held_out/psnr")]
    assert logged == [(0, metrics["prior"]["psnr"]), (60, metrics["result"]["psnr"])]
    assert [event.step for event in events.Images("validation/0")] == [60]
    assert events.Images("validation/0")[0].width > events.Images("validation/0")[0].height


def tensorboard_events(folder):
    """The scalars and pictures that a run has given to TensorBoard."""
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    return EventAccumulator(str(folder / "tb_logs" / "version_0")).Reload()


@pytest.mark.parametrize(("steps", "times"), [(2, 0), (3, 1)])
def test_a_run_long_enough_for_its_pool_has_the_pictures_cast_at_once(
    tmp_path, painted_box, monkeypatch, steps, times
):
    cast = []
    monkeypatch.setattr(
        MeshTruth,
        "prefetch",
        lambda self, *views: cast.append((len(views[0]), *views[2:])),
    )
    options = ["data.width=48", "data.height=48", "system.renderer.downsample=2"]
    assert (
        launch(
            tmp_path,
            painted_box,
            *options,
            f"trainer.max_steps={steps}",
            "system.exporter.save_video=false",
        )
        == 0
    )
    assert cast == [(12, 24, 24)] * times


def test_looking_at_pictures_is_no_training_time(tmp_path, painted_box, monkeypatch):
    clock = np.zeros(2)
    monkeypatch.setattr(evaluate, "_now", clock.copy)
    for name, hours in (("training_step", 1), ("show", 100)):
        body = getattr(GaussianDreamerSystem, name)
        monkeypatch.setattr(
            GaussianDreamerSystem,
            name,
            lambda *args, body=body, hours=hours: (clock.__iadd__(hours), body(*args))[1],
        )
    assert (
        launch(
            tmp_path,
            painted_box,
            "trainer.max_steps=2",
            "trainer.val_check_interval=1",
            "system.exporter.save_video=false",
        )
        == 0
    )
    assert json.loads((trial(tmp_path) / "save" / "metrics.json").read_text())["seconds"] == 2


def test_a_run_exports_the_pruned_cloud_too_and_so_does_export(tmp_path, painted_box):
    options = [
        "system.prune.count=90",
        "system.prune.size=32",
        "system.prune.steps=3",
        "system.exporter.formats=[ply,spz]",
    ]
    assert (
        launch(
            tmp_path, painted_box, *options, "trainer.max_steps=4", "trainer.val_check_interval=4"
        )
        == 0
    )
    export = trial(tmp_path) / "save" / "it4-export"
    assert len(read_gaussians(export / "gaussians.ply").means) == 200
    first = read_gaussians(export / "pruned" / "gaussians.ply")
    assert len(first.means) == len(read_spz(export / "pruned" / "gaussians.spz").means) == 90
    report = json.loads((export / "pruned" / "report.json").read_text())
    assert (
        report["options"]["eps2d"] == 0.1 and not report["options"]["antialias"]
    )  # as the demo draws
    assert (
        report["after"]["gaussians"] == 90 and (export / "pruned" / "report.png").stat().st_size > 0
    )
    shutil.rmtree(export)
    resume = [
        f"resume={trial(tmp_path) / 'ckpts' / 'last.ckpt'}",
        "system.exporter.save_video=false",
    ]
    assert launch(tmp_path, painted_box, *options, *resume, stage="--export") == 0
    (again,) = trial(tmp_path).parent.glob("*/save/it4-export/pruned/gaussians.ply")
    assert all(
        a.tobytes() == b.tobytes() for a, b in zip(read_gaussians(again), first, strict=True)
    )


@pytest.mark.slow
def test_a_budget_without_a_round_to_come_says_so(tmp_path, painted_box, capsys):
    """Also of a run that goes on where its rounds are over."""
    steps = ["trainer.max_steps=7", "trainer.val_check_interval=7"]
    assert launch(tmp_path, painted_box, *PRUNE, *steps) == 0
    assert "no round of pruning" not in "".join(capsys.readouterr())
    resume = f"resume={trial(tmp_path) / 'ckpts' / 'last.ckpt'}"
    options = [
        *PRUNE,
        "system.geometry.budget=100",
        "trainer.max_steps=9",
        "trainer.val_check_interval=9",
    ]
    assert launch(tmp_path, painted_box, *options, resume) == 0
    assert "no round of pruning is to come, so that 130 Gaussians stay, not 100" in "".join(
        capsys.readouterr()
    )


def test_pruned_exports_note_what_they_have_spent(tmp_path, painted_box, capsys):
    options = [
        "system.prune.psnr=25",
        "system.prune.size=32",
        "system.prune.steps=3",
        "system.exporter.formats=[ply,spz]",
    ]
    assert (
        launch(
            tmp_path, painted_box, *options, "trainer.max_steps=2", "trainer.val_check_interval=2"
        )
        == 0
    )
    files = trial(tmp_path) / "save" / "it2-export" / "pruned"
    said = capsys.readouterr().out
    for name in ("gaussians.ply", "gaussians.spz"):
        assert str(files / name) in said  # where everything is
        assert read_cloud(str(files / name)).pruned_to == 25


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["system.prune.count=0"], "system.prune.count: expected a whole number from 1 on"),
        (
            ["system.prune.count=9", "system.prune.psnr=40"],
            "system.prune.psnr: give one budget; count is one too",
        ),
        (["system.prune.bytes=lots"], "system.prune.bytes: expected a size such as 500kB"),
    ],
)
def test_a_wrong_pruning_budget_is_found_before_the_run(
    tmp_path, painted_box, capsys, options, said
):
    assert launch(tmp_path, painted_box, *options) == 2
    assert said in capsys.readouterr().err


DENSIFY = [
    f"system.geometry.densify.{option}"
    for option in (
        "enabled=true",
        "start=2",
        "stop=8",
        "every=2",
        "grad_threshold=1e-4",
        "min_opacity=0.01",
    )
]
PRUNE = [
    "system.geometry.budget=130",
    *(f"system.geometry.prune.{option}" for option in ("start=3", "stop=8", "every=3")),
]


@pytest.mark.parametrize("known", [True, False])
def test_auto_says_what_it_measured(tmp_path, painted_box, capsys, known):
    """The loss against the truth; where a guidance knows none, how like the renders before and
    after are.
    """
    options = [
        "system.geometry.budget=auto",
        "system.geometry.min_gaussians=20",
        "trainer.max_steps=6",
        "trainer.val_check_interval=6",
    ]
    options += [
        f"system.geometry.prune.{rule}"
        for rule in ("start=0", "stop=6", "every=2", "quality=60", "likeness=1")
    ]
    config = CONFIGS / "demo.yaml" if known else mocked_config(tmp_path, painted_box)
    options += [f"system.guidance.mesh={painted_box}"] if known else []
    assert (
        main(
            [
                "--config",
                str(config),
                "--train",
                "--gpu",
                "cpu",
                f"exp_root_dir={tmp_path}",
                *SMALL,
                *options,
            ]
        )
        == 0
    )
    said = [line for line in "".join(capsys.readouterr()).splitlines() if "Gaussians; dB" in line]
    measured = r"lost -?[\d.e-]+, affordable 30" if known else r"likeness [\d.]+, asked_for 1"
    pattern = r"step (2|4): (\d+) -> (\d+) Gaussians; dB on the views of this step: " + measured
    rounds = [re.search(pattern, line) for line in said]
    assert len(rounds) == 2 and all(int(found[3]) == int(0.8 * int(found[2])) for found in rounds)
    rows = list(csv.DictReader(open(trial(tmp_path) / "csv_logs" / "version_0" / "metrics.csv")))
    assert any(row.get("prune/lost" if known else "prune/likeness") for row in rows)


def test_a_budget_that_needs_larger_rounds_is_met_and_says_so(tmp_path, painted_box, capsys):
    options = [
        *PRUNE,
        "system.geometry.budget=70",
        "trainer.max_steps=8",
        "trainer.val_check_interval=8",
    ]
    assert launch(tmp_path, painted_box, *options) == 0
    told = (
        r"2 rounds of pruning have to lead from \d+ Gaussians to 70: each keeps 0.[56]\d "
        r"instead of 0.8"
    )
    assert re.search(told, "".join(capsys.readouterr()))
    assert len(cloud_of(trial(tmp_path) / "ckpts" / "last.ckpt")["geometry.means"]) == 70


@pytest.mark.slow
@pytest.mark.parametrize(
    ("changes", "stop"), [(DENSIFY, 3), (DENSIFY, 4), (DENSIFY, 5), (PRUNE, 2), (PRUNE, 4)]
)
def test_a_stopped_and_resumed_run_equals_the_run_that_never_stopped(
    tmp_path, painted_box, changes, stop
):
    """Bit for bit: Gaussians, moments, statistics; the stops lie before, at and after a change of
    the cloud, with more validation.
    """
    options = [*changes, "checkpoint.every_n_train_steps=1"]
    assert (
        launch(
            tmp_path / "whole",
            painted_box,
            *options,
            "trainer.max_steps=9",
            "trainer.val_check_interval=9",
        )
        == 0
    )
    assert (
        launch(
            tmp_path / "parts",
            painted_box,
            *options,
            f"trainer.max_steps={stop}",
            "trainer.val_check_interval=1",
        )
        == 0
    )
    last = trial(tmp_path / "parts") / "ckpts" / "last.ckpt"
    assert changes is DENSIFY or cloud_of(last)["geometry.removal"].any()  # stopped between samples
    assert (
        launch(
            tmp_path / "parts",
            painted_box,
            *options,
            "trainer.max_steps=9",
            "trainer.val_check_interval=2",
            f"resume={last}",
        )
        == 0
    )
    whole, parts = (
        torch.load(trial(tmp_path / name) / "ckpts" / "last.ckpt", weights_only=True)
        for name in ("whole", "parts")
    )
    assert whole["global_step"] == parts["global_step"] == 9
    count = len(whole["state_dict"]["geometry.means"])
    assert count > 250 if changes is DENSIFY else count == 130
    assert same(whole["state_dict"], parts["state_dict"])
    states = [c["optimizer_states"][0]["state"] for c in (whole, parts)]
    assert all(
        torch.equal(states[0][i][k], states[1][i][k])
        for i in states[0]
        for k in ("exp_avg", "exp_avg_sq", "step")
    )


def test_test_validate_and_export_use_the_checkpoint_and_no_prior(tmp_path, painted_box):
    mesh = tmp_path / "box.glb"
    mesh.write_bytes(painted_box.read_bytes())
    assert launch(tmp_path, mesh, "trainer.max_steps=3", "trainer.val_check_interval=3") == 0
    save, last = trial(tmp_path) / "save", trial(tmp_path) / "ckpts" / "last.ckpt"
    trained = (save / "it3-test" / "1.png").read_bytes()
    for path in (
        *save.glob("it3-test/*"),
        *save.glob("it3-export/*"),
        save / "it3-0.png",
        save / "it3-test.mp4",
    ):
        path.unlink()
    mesh.unlink()  # neither prior nor target is needed any more
    for stage in ("--test", "--validate", "--export"):
        assert launch(tmp_path, mesh, f"resume={last}", stage=stage) == 0
    assert (save / "it3-test" / "1.png").read_bytes() == trained
    assert (save / "it3-0.png").is_file()
    exported = read_gaussians(save / "it3-export" / "gaussians.ply")
    means = cloud_of(last)["geometry.means"].numpy()
    assert np.array_equal(exported.means, means[:, [1, 2, 0]] * np.float32([1, -1, -1]))


@pytest.mark.parametrize("name, sign", [("sparsity", -1), ("opaque", 1)])
def test_regularisers_have_real_gradients_on_the_real_alpha(tmp_path, painted_box, name, sign):
    """Sparsity makes the cloud fainter; opaque pushes alphas above one half to one."""
    base = [
        "trainer.max_steps=15",
        "trainer.val_check_interval=15",
        "system.geometry.init_opacity=0.7",
    ]
    weights = ["system.loss.lambda_sds=0", f"system.loss.lambda_{name}=100"]
    assert launch(tmp_path, painted_box, *base, *weights) == 0
    opacity = torch.sigmoid(
        cloud_of(trial(tmp_path) / "ckpts" / "last.ckpt")["geometry.logit_opacities"]
    ).mean()
    assert sign * (opacity - 0.7) > 0.02


def test_a_learned_background_learns_and_is_in_the_checkpoint(tmp_path, painted_box):
    config = mocked_config(
        tmp_path, painted_box, background={"mode": "learned", "color": [0.5, 0.5, 0.5], "lr": 0.1}
    )
    overrides = [
        f"exp_root_dir={tmp_path}",
        *SMALL,
        "trainer.max_steps=20",
        "trainer.val_check_interval=20",
    ]
    assert main(["--config", str(config), "--train", "--gpu", "cpu", *overrides]) == 0
    color = torch.sigmoid(cloud_of(trial(tmp_path) / "ckpts" / "last.ckpt")["background.logit"])
    assert (
        color[0] > 0.7 and color[1] < 0.35 and color[2] < 0.3
    )  # on its way from grey to the mock's (0.9, 0.2, 0.1)


def test_the_weight_of_a_loss_that_nobody_returns_is_named(tmp_path, painted_box, capsys):
    assert (
        launch(tmp_path, painted_box, "system.loss.lambda_spasity=1.0", "trainer.max_steps=2") == 2
    )
    assert "lambda_sparsity" in capsys.readouterr().err


NON_FINITE = {  # each makes a run's parameters or moments NaN or infinite in its first steps
    "eps": ["system.optimizer.args.eps=0"],
    "loss": ["system.loss.lambda_sds=1e38"],
}


@pytest.mark.parametrize("cause", NON_FINITE)
def test_a_run_that_turns_non_finite_stops_and_saves_nothing_of_it(
    tmp_path, painted_box, monkeypatch, capsys, cause
):
    monkeypatch.setattr(system, "CHECK_EVERY", 3)
    steps = ["trainer.max_steps=5", "trainer.val_check_interval=5"]
    assert launch(tmp_path, painted_box, *steps, *NON_FINITE[cause]) == 2
    errors = capsys.readouterr().err
    assert errors.count("are NaN or infinite: the run stops") == 1 and "step 3:" in errors
    assert not [*tmp_path.rglob("*.ckpt"), *tmp_path.rglob("it*")]


@pytest.mark.slow
def test_a_non_finite_state_never_replaces_a_good_checkpoint(tmp_path, painted_box, monkeypatch):
    """The checkpoint of the step before stays; resumed from it, the run ends as it should."""
    step = GaussianDreamerSystem.training_step

    def poisoned(self, batch, batch_idx):
        step(self, batch, batch_idx)
        if self.global_step == 3:
            self.geometry.means.data[5, 1] = torch.nan

    monkeypatch.setattr(GaussianDreamerSystem, "training_step", poisoned)
    every = [
        "checkpoint.every_n_train_steps=1",
        "trainer.max_steps=4",
        "trainer.val_check_interval=4",
    ]
    assert launch(tmp_path, painted_box, *every) == 2
    last = trial(tmp_path) / "ckpts" / "last.ckpt"
    found = torch.load(last, weights_only=True)
    assert found["global_step"] == 2 and found["state_dict"]["geometry.means"].isfinite().all()
    monkeypatch.undo()
    assert launch(tmp_path, painted_box, *every, f"resume={last}") == 0


@pytest.mark.parametrize("stage", ["--test", "--export"])
def test_a_cloud_that_is_not_finite_is_neither_shown_nor_exported(
    tmp_path, painted_box, monkeypatch, capsys, stage
):
    ensure_cloud = GaussianDreamerSystem.ensure_cloud

    def poisoned(self):
        ensure_cloud(self)
        self.geometry.sh0.data[7] = torch.inf

    monkeypatch.setattr(GaussianDreamerSystem, "ensure_cloud", poisoned)
    assert launch(tmp_path, painted_box, stage=stage) == 2
    assert "3 of the 600 numbers of geometry.sh0 are NaN or infinite" in capsys.readouterr().err
    assert not list(tmp_path.rglob("it*"))
