"""The shipped configurations trained with tiny random models in the real ones' files."""

import csv
from pathlib import Path

import numpy as np
import pytest

from tests.helpers import tiny_3d_models, tiny_models
from threestudio_gaussiandreamer.formats.gaussian_files import read_cloud
from threestudio_gaussiandreamer.guidance.text_to_image import TextToImageDistillation
from threestudio_gaussiandreamer.launch.experiment import main
from threestudio_gaussiandreamer.priors import shap_e

pytest.importorskip("diffusers")
pytestmark = pytest.mark.slow

CONFIGS = Path(__file__).parents[2] / "configs"
STEPS = 2
SIZES = [
    "data.width=64", "data.height=64", "data.eval_width=32", "data.eval_height=32",
    "data.n_val_views=1", "data.n_test_views=2", "system.geometry.grow.num_candidates=20000",
    f"trainer.max_steps={STEPS}",
    f"trainer.val_check_interval={STEPS}", "trainer.enable_progress_bar=false", "name=run", "tag=t",
    "use_timestamp=false", "system.geometry.budget=null",
]  # fmt: skip


def guided_by(model):
    return {"system.guidance.pretrained_model_name_or_path": model}


@pytest.fixture(scope="module")
def models(tmp_path_factory):
    """Write every model that the configurations name, and return the options that select them."""
    folder = tmp_path_factory.mktemp("models")
    base, upsampler = tiny_3d_models.point_e(folder / "point-e")
    clip = tiny_3d_models.clip(folder / "clip")
    body = tiny_3d_models.body_model(folder / "body.npz")
    return {
        "epsilon": guided_by(tiny_models.stable_diffusion(folder / "epsilon")),
        "deep_floyd": guided_by(tiny_models.deep_floyd(folder / "if")),
        # the size that the configuration sets is that of the real model
        "sd3": guided_by(tiny_models.stable_diffusion_3(folder / "sd3"))
        | {"system.guidance.image_size": 64},
        "sdxl": guided_by(tiny_models.stable_diffusion_xl(folder / "sdxl")),
        "mvdream": guided_by(tiny_models.mvdream(folder / "mvdream")),
        "shap_e": prior(model=tiny_3d_models.shap_e(folder / "shap-e")),
        "point_e": prior(checkpoint=base, upsampler=upsampler, num_steps=2, num_points=64)
        | prior(clip=clip),
        "motion": prior(motion=motion(folder), body_model=body, clip=clip, num_points=400),
        "anny": prior(num_points=400, pose="walking"),
    }


def prior(**options):
    return {f"system.geometry.prior.{name}": value for name, value in options.items()}


def motion(folder):
    """Return a motion in MDM's layout (samples, joints, 3, frames), metres: an arm is raised."""
    frames = np.repeat(tiny_3d_models.JOINTS[None, :22, :, None], 4, axis=3)
    frames[0, 20, 1] += np.linspace(0, 0.1, 4)
    texts, lengths = np.array(["Someone waves"]), np.array([4])
    np.savez(folder / "results.npz", motion=frames, text=texts, lengths=lengths)
    return folder / "results.npz"


@pytest.fixture(autouse=True)
def small_shap_e(monkeypatch):
    monkeypatch.setattr(shap_e, "STEPS", 2)
    monkeypatch.setattr(shap_e, "GRID_SIZE", 24)


def train(configs, options):
    """Run the command of a user in the current folder; return the folder of its results."""
    words = [word for name in configs for word in ("--config", str(CONFIGS / name))]
    overrides = [f"{key}={value}" for key, value in options.items()]
    prompt = "system.prompt_processor.prompt=Iron man kicks with his left leg"
    assert main([*words, "--train", "--gpu", "cpu", prompt, *SIZES, *overrides]) == 0
    return Path("outputs/run/t")


def assert_trained(folder, rate, ground=0):
    """Assert that all results exist, and points moved as Adam allows at this rate; return those."""
    save = folder / "save"
    cloud = read_cloud(str(save / f"it{STEPS}-export" / "gaussians.ply")).in_axes("z").gaussians
    points = np.load(save / "prior" / "points.npz")["points"]
    assert all(np.isfinite(values).all() for values in cloud)
    assert len(cloud.means) > len(points)  # Algorithm 1 added some, after the prior's own
    first_grown = len(points) - ground
    grown = np.s_[first_grown : first_grown + len(cloud.means) - len(points)]
    moved = np.abs(np.delete(cloud.means, grown, axis=0) - points)
    # a step of Adam is at most lr (1 - b1) / sqrt(1 - b2) = lr for betas 0.9 and 0.99, 3.2 lr for
    # 0.999; float32 rounds at 1e-7
    assert 0.5 * rate < moved.max() < 3.2 * STEPS * rate + 1e-6
    for name in (f"it{STEPS}-0.png", f"it{STEPS}-test.mp4"):
        assert (save / name).is_file(), name
    with open(folder / "csv_logs" / "version_0" / "metrics.csv") as file:
        losses = [float(x["train/loss_sds"]) for x in csv.DictReader(file) if x["train/loss_sds"]]
    assert len(losses) == STEPS and all(np.isfinite(losses)) and min(losses) > 0
    return points


RUNS = {
    "paper": ("", "shap_e epsilon"),
    "official": ("", "shap_e epsilon"),
    "if": ("-if", "shap_e deep_floyd"),
    "pointe": ("-pointe", "point_e epsilon"),
    "avatar": ("-avatar", "anny epsilon"),
    "avatar of smpl": ("-avatar-smpl", "motion epsilon"),
    "ground": ("-ground", "shap_e epsilon"),
    "sdxl": ("-sdxl", "shap_e sdxl"),
    "sd3": ("-sd3", "shap_e sd3"),
    "mvdream": ("-mvdream", "shap_e mvdream"),
    "lowmem": ("-lowmem", "shap_e epsilon"),
    "without pruning": ("-paper", "shap_e epsilon"),
}
"""Suffixes of the configurations that are added to gaussiandreamer.yaml, and models."""


def configs_of(name):
    if name == "official":
        return ["gaussiandreamer-official.yaml"]
    return ["gaussiandreamer.yaml", *(f"gaussiandreamer{x}.yaml" for x in RUNS[name][0].split())]


@pytest.mark.parametrize("name", RUNS)
def test_a_configuration_trains(name, models, recorded, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    seen = recorded(TextToImageDistillation, "predict_rows")
    used = RUNS[name][1].split()
    if "anny" in used:
        pytest.importorskip("anny")
    options = {key: value for part in used for key, value in models[part].items()}
    folder = train(configs_of(name), options)
    # four views with and without the prompt, in one forward pass a step; what validation draws has
    # one view
    rows = [len(text) for (_, z, _, text, *_), _ in seen if len(z) == 4]
    assert rows == [8] * STEPS
    ground = 20000 if name == "ground" else 0
    points = assert_trained(folder, 2e-4 if name == "official" else 5e-5, ground)
    if ground:
        assert (points[-ground:, 2] == points[-1, 2]).all()
        assert points[:-ground, 2].min() == pytest.approx(points[-1, 2])


def test_every_configuration_for_models_is_trained():
    shipped = {path.name for path in CONFIGS.glob("gaussiandreamer*.yaml")}
    assert shipped == {name for run in RUNS for name in configs_of(run)}
