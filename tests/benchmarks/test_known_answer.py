"""On images of exactly M Gaussians, starting from 4 M with duplicates and floaters, `budget: auto`
and the prune command keep at most 1.2 M.
"""

import pytest
import torch

from threestudio_gaussiandreamer.gaussians.gaussians import Gaussians
from threestudio_gaussiandreamer.gaussians.recover import Recovery
from threestudio_gaussiandreamer.gaussians.simplify import Budget, simplify
from threestudio_gaussiandreamer.gaussians.views import psnr_to_original, render_all, views_around
from threestudio_gaussiandreamer.metrics import psnr
from threestudio_gaussiandreamer.splatting import rasterize
from threestudio_gaussiandreamer.training.density import DensityControl, QualityResult
from threestudio_gaussiandreamer.training.geometry import GaussianCloud

known_answer = pytest.importorskip(
    "benchmarks.quality.known_answer", reason="needs tqdm and the benchmarks beside the tests"
)

M, SIZE, STEPS = 80, 64, 600
RATES = {
    "lr_means": [0, 2e-4, 2e-5, STEPS],
    "lr_scales": [0, 6e-2, 1e-3, STEPS],
    "lr_quats": [0, 6e-2, 2e-3, STEPS],
    "lr_opacities": [0, 1e-1, 5e-3, STEPS],
    "lr_sh": [0, 1e-1, 2e-3, STEPS],
}
"""Those of configs/demo.yaml."""


def trained(geometry, views, pictures):
    """Fit a cloud to the images for a short run: the system's steps without its host."""
    adam = torch.optim.Adam(geometry.parameter_groups(), betas=(0.9, 0.99), eps=1e-15)
    rng = torch.Generator().manual_seed(0)

    def draw(rows, opacities=None):
        opacities = geometry.opacities() if opacities is None else opacities
        colors = geometry.colors(views.positions[rows])
        cloud = geometry.means, geometry.quats, geometry.scales(), opacities, colors
        camera = views.viewmats[rows], views.Ks[rows]
        return rasterize(*cloud, *camera, SIZE, SIZE, background=views.backgrounds[rows])

    control = DensityControl(geometry)
    for step in range(1, STEPS + 1):
        geometry.set_learning_rates(adam, 0, step)
        rows = torch.randperm(len(pictures), generator=rng)[:4]
        opacities = geometry.opacities()
        out = draw(rows, opacities)
        behind = views.backgrounds[rows][:, None, None]
        pictures_now = {
            "comp_rgb": out.image,
            "opacity": out.alpha,
            "comp_rgb_bg": behind,
            "gaussian_opacities": opacities,
        }
        control.before_backward(pictures_now, step - 1)
        (0.5 * (out.image - pictures[rows]).square().sum() / 4).backward()
        control.after_backward(out, SIZE, SIZE)
        adam.step()
        adam.zero_grad(set_to_none=True)

        @torch.no_grad()
        def check(kept, rows=rows):
            whole = psnr(draw(rows).image, pictures[rows])
            with geometry.showing_only(kept):
                loss = whole - psnr(draw(rows).image, pictures[rows])
            return QualityResult(control.affordable_loss - loss, {})

        control.after_step(adam, step, check)
    return Gaussians.of(geometry)


def test_auto_finds_the_true_number_with_visible_floaters_and_copies():
    true = known_answer.torus(M, 0)
    start = known_answer.with_copies_and_floaters(true, 0)
    views, unseen = (
        views_around(true, count, SIZE, turn=turn) for count, turn in ((48, 0.0), (16, 60.0))
    )
    truth = render_all(true, unseen)
    assert len(start.means) == 4 * M and psnr_to_original(start, unseen, truth) < 24
    schedule = {"start": STEPS // 12, "stop": STEPS * 3 // 4, "every": STEPS // 24}
    geometry = GaussianCloud({"budget": "auto", "min_gaussians": 8, "prune": schedule, **RATES})
    geometry.set_arrays(**start._asdict())
    geometry.merge_duplicates()
    assert len(geometry) < 2.2 * M
    found = trained(geometry, views, render_all(true, views))
    assert len(found.means) <= 1.2 * M
    assert psnr_to_original(found, unseen, truth) >= 40


def test_prune_finds_the_true_number_with_shared_opacity_and_faint_floaters():
    true = known_answer.torus(M, 0)
    start = known_answer.with_shares_and_faint_floaters(true, 0)
    views = [
        views_around(true, count, SIZE, turn=turn)
        for count, turn in ((48, 0.0), (32, 45.0), (16, 60.0))
    ]
    found = simplify(start, Budget(psnr=40.0), Recovery(start, *views[:2], steps=40))
    assert len(found.means) <= 1.2 * M
    # on other views than those that decide, which are two standard errors on the safe side: 40.1 to
    # 41.5 dB with seeds 0 to 3
    assert psnr_to_original(found, views[2], render_all(start, views[2])) >= 40
