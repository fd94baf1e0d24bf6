"""Score distillation over whole runs: annealing, clipping, priors and backgrounds."""

import csv
from pathlib import Path

import pytest
import torch

from tests.stability.rows import row
from tests.stability.small_runs import Ended, launch
from threestudio_gaussiandreamer import cameras, register_parts
from threestudio_gaussiandreamer.host import find
from threestudio_gaussiandreamer.meshes.load import load_mesh
from threestudio_gaussiandreamer.meshes.raycast import MeshCaster, over_background
from threestudio_gaussiandreamer.metrics import psnr
from threestudio_gaussiandreamer.splatting import rasterize
from threestudio_gaussiandreamer.training.held_out import EvaluationConfig, HeldOut

register_parts()


RESULTS = Path(__file__).parents[2] / "benchmarks" / "results"


# ---- what guidance does to colours and faces -----------------------------------------------------

# configs/demo.yaml's schedules span the whole run; a short one gets them in proportion
RATES = {
    "means": (4e-4, 2e-5),
    "scales": (6e-2, 1e-3),
    "quats": (6e-2, 2e-3),
    "opacities": (1e-1, 5e-3),
    "sh": (1e-1, 2e-3),
}


POINTS = ["system.geometry.prior.num_points=1500"]


LATENT = [
    "system.guidance.space=latent",
    "system.guidance.latent_size=16",
    "system.guidance.bank_views=100",
]


STRONG = [*LATENT, "system.guidance.guidance_scale=101.0"]


BLIND = [
    *LATENT,
    "system.guidance.mode=view-agnostic",
    "data.camera_distance_range=[2.5,2.5]",
    "data.fovy_range=[50,50]",
    # fmt: skip
    "system.guidance.bank_distance_range=[2.5,2.5]",
    "system.guidance.bank_fovy_range=[50,50]",
]


RANDOM_START = [
    *POINTS,
    "system.geometry.prior_type=random-prior",
    "system.geometry.prior.shape=sphere",
]


def trained(folder, steps, size, *options) -> Ended:
    """Train long enough for a result: ``size`` pixels, timesteps up to 0.55 after five twelfths of
    the run.
    """
    middle = steps * 5 // 12
    rates = [
        f"system.geometry.lr_{name}=[0,{start},{end},{steps}]"
        for name, (start, end) in RATES.items()
    ]
    sizes = [f"data.{side}={size}" for side in ("width", "height")] + [
        "data.train_views=40",
        f"trainer.max_steps={steps}",
    ]
    measured = [
        "system.evaluation.size=48",
        "system.evaluation.views=8",
        "system.evaluation.supersample=2",
        "trainer.log_every_n_steps=50",
    ]
    annealed = f"system.guidance.max_step_percent=[{middle},0.98,0.55,{middle + 1}]"
    ended = launch(folder, *rates, *sizes, *measured, annealed, *options)
    assert ended.code == 0, ended.err
    return ended


@pytest.mark.slow
@row("A4", "Guidance 100: over-saturation")
def test_annealing_helps_and_clipping_helps_more(tmp_path, measured):
    """The exact score of the toy in a latent, at guidance 100 and, for comparison, without
    guidance.
    """
    variants = {
        "as it is": [*STRONG, "system.guidance.max_step_percent=0.98"],
        "annealed": STRONG,
        "annealed and clipped": [*STRONG, "system.guidance.grad_clip=[0,1.5,2.0,150]"],
        "no guidance": LATENT,
    }
    results = {}
    for name, options in variants.items():
        # over-saturation is measured out of gamut, which bounded colours can't be
        unbounded = "system.geometry.bound_colors=false"
        options = ["data.batch_size=4", unbounded, *POINTS, *options]
        results[name] = trained(tmp_path / name.replace(" ", "-"), 150, 48, *options).metrics()[
            "result"
        ]
        measured(
            results[name]["psnr"],
            "dB",
            what=f"guidance 100 {name}" if name != "no guidance" else name,
        )
        measured(100 * results[name]["out_of_gamut"], "%", what=f"out of gamut {name}")
    dB = [result["psnr"] for result in results.values()]
    # 15.1, 16.6, 19.1 and 23.1 dB here
    assert dB[0] + 0.5 < dB[1] and dB[1] + 1 < dB[2] and dB[2] + 1 < dB[3], dB
    assert (
        results["as it is"]["out_of_gamut"]
        > results["annealed and clipped"]["out_of_gamut"]
        > results["no guidance"]["out_of_gamut"]
    )


@pytest.mark.slow
@row("A4", "Janus")
def test_a_prior_prevents_multiple_faces_and_a_random_start_does_not(tmp_path, measured):
    """A view-blind score and short runs; measured with the package's metric, which is in every
    run's metrics.json.
    """
    starts = {"prior": POINTS, "random": RANDOM_START}
    rates = {
        name: 100
        * trained(tmp_path / name, 100, 48, *BLIND, *start).metrics()["result"]["multi_face"]
        for name, start in starts.items()
    }
    measured(rates["prior"], "% multi-face", what="prior", at_most=5)
    measured(rates["random"], "% multi-face", what="random start", at_least=50)


@row("A4", "Janus")
def test_the_table_of_five_seeds(measured):
    """Runs of 1200 steps at 128 pixels, by `python -m benchmarks.quality.ablations --table
    faces`.
    """
    lines = [
        line
        for line in (RESULTS / "faces.csv").read_text().splitlines()
        if not line.startswith("#")
    ]
    rows = {row["variant"]: row for row in csv.DictReader(lines)}
    assert all(int(row["seeds"]) >= 5 for row in rows.values())
    measured(
        100 * float(rows["prior"]["multi_face"]),
        "% multi-face",
        what="prior, five seeds of 1200 steps",
        at_most=5,
    )
    measured(
        100 * float(rows["random start"]["multi_face"]),
        "% multi-face",
        what="random start, five seeds of 1200 steps",
        at_least=50,
    )


@pytest.mark.slow
@row("A4", "Colour drift, background shortcut")
def test_the_cloud_does_not_depend_on_the_background(tmp_path, measured):
    """Only the alpha error differs between backgrounds, mostly at the outline; the spread is below
    1 dB at the end of the demo's schedules, not yet after three fifths of them. With the usual
    dilation of 0.3 square pixels instead of the demo's 0.03 the spread is larger, and larger still
    for training on black alone, as in the paper's code.
    """
    ended = trained(
        tmp_path, 500, 96, "system.geometry.prior.num_points=3000", "data.train_views=60"
    )
    state = ended.checkpoint()["state_dict"]
    cloud = find("gaussiandreamer-cloud")({})
    cloud.load_state_dict(
        {
            name.removeprefix("geometry."): value
            for name, value in state.items()
            if name.startswith("geometry.")
        }
    )
    held_out = HeldOut(EvaluationConfig(views=8, size=96), MeshCaster(load_mesh("toy.glb")))
    backgrounds = {"black": (0.0, 0.0, 0.0), "white": (1.0, 1.0, 1.0), "magenta": (1.0, 0.0, 1.0)}
    images = {
        name: drawn_on(cloud, held_out.orbit, torch.tensor(color))
        for name, color in backgrounds.items()
    }
    alpha = 1 - (images["white"] - images["black"]).mean(-1)
    measured((alpha - held_out.truth[..., 3]).abs().mean(), what="alpha error", at_most=0.02)
    truths = {
        name: over_background(held_out.truth, torch.tensor(color))
        for name, color in backgrounds.items()
    }
    scores = [float(psnr(images[name].clamp(0, 1), truths[name])) for name in backgrounds]
    assert min(scores) > 25
    measured(max(scores) - min(scores), "dB", what="spread over three backgrounds", at_most=1.0)


@torch.no_grad()
def drawn_on(cloud, orbit, background):
    c2w = orbit.c2w
    viewmats, Ks = cameras.to_opencv(c2w, orbit.fovy, 96, 96)
    gaussians = (
        cloud.means,
        cloud.quats,
        cloud.scales(),
        cloud.opacities(),
        cloud.colors(c2w[:, :3, 3]),
    )
    drawn = {"eps2d": 0.03, "antialias": True}  # as demo.yaml draws
    return rasterize(*gaussians, viewmats, Ks, 96, 96, background=background, **drawn).image
