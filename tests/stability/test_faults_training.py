"""A0: faults of other training code. Each test holds ours to the bar and shows that an emulation of
the fault breaks it.
"""

from types import SimpleNamespace

import numpy as np
import pytest
import torch
from torch import nn

from tests.stability.faults_training_cases import ball, started
from tests.stability.rows import row
from threestudio_gaussiandreamer.core.streams import generator
from threestudio_gaussiandreamer.gaussians import densify
from threestudio_gaussiandreamer.gaussians.densify import PARAMETERS, Rules, Statistics
from threestudio_gaussiandreamer.gaussians.grow import grow
from threestudio_gaussiandreamer.gaussians.point_cloud import PointCloud
from threestudio_gaussiandreamer.training.density import DensityControl
from threestudio_gaussiandreamer.training.geometry import STATISTICS, GaussianCloud
from threestudio_gaussiandreamer.training.initialization import grow_points

# ---- state and memory ----------------------------------------------------------------------------


@row("A0", "F11")
def test_f11_the_loss_scale_does_not_affect_the_selection(fault):
    """Half of the gradients are above the threshold; mixed precision multiplies all of them by 65
    536.
    """
    g = torch.Generator().manual_seed(0)
    true = torch.randn(2, 1000, 2, generator=g) * torch.tensor([2e-4 / 64, 2e-4 / 64])

    def as_they_come(means2d_grad, width, height, loss_scale):
        return densify.screen_gradients(means2d_grad, width, height)

    def deviation(gradients):
        selected = [gradients(true * scale, 128, 128, scale) > 2e-4 for scale in (1.0, 65536.0)]
        return (selected[0] != selected[1]).float().mean() * 100

    fault(
        deviation,
        ours=densify.screen_gradients,
        emulation=as_they_come,
        unit="% selected differently",
    )


@row("A0", "F12")
def test_f12_a_checkpoint_holds_the_cloud_and_its_statistics(fault):
    """The emulation keeps the cloud in a plain object, which is not in a module's state. Ours does
    not run the prior on loading.
    """

    class PlainCloud(nn.Module):
        def __init__(self, source=None):
            super().__init__()
            names = (*PARAMETERS, *STATISTICS)
            self.cloud = SimpleNamespace(
                **{name: getattr(source, name) if source else torch.zeros(0) for name in names}
            )

        def __getattr__(self, name):
            cloud = self.__dict__.get("cloud")
            return (
                getattr(cloud, name)
                if cloud is not None and hasattr(cloud, name)
                else super().__getattr__(name)
            )

    def trained():
        geometry = started()
        geometry.gradient_sum += 1
        geometry.contribution += torch.rand(300, generator=torch.Generator().manual_seed(0))
        return geometry

    def deviation(pair):
        saved, fresh = pair()
        fresh.load_state_dict(saved.state_dict())
        return sum(
            not torch.equal(getattr(saved, name), getattr(fresh, name))
            for name in (*PARAMETERS, *STATISTICS)
        )

    fault(
        deviation,
        ours=lambda: (trained(), GaussianCloud({"prior_type": "a-prior-that-does-not-exist"})),
        emulation=lambda: (PlainCloud(trained()), PlainCloud()),
        unit="tensors lost",
    )


@row("A0", "F16")
def test_f16_growing_leaves_the_process_generators_alone(fault):
    def reseeding(cloud):
        np.random.seed(0)
        return np.random.uniform(-1, 1, (1000, 3))

    def deviation(grown):
        np.random.seed(7)
        expected, torch_state = np.random.RandomState(7).random(), torch.get_rng_state()
        grown(ball())
        return float(np.random.random() != expected) + float(
            not torch.equal(torch.get_rng_state(), torch_state)
        )

    def ours(cloud):
        return grow(cloud, num_candidates=1000, generator=np.random.default_rng(0))

    fault(deviation, ours=ours, emulation=reseeding, unit="generators moved")


# ---- growing -------------------------------------------------------------------------------------


@row("A0", "F14")
def test_f14_without_grown_points_the_input_is_returned(fault):
    """A cube of side 2 has eight corners; none of 100 candidates is near one."""
    corners = np.float32([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])

    def ours(points):
        cloud = PointCloud(points, np.full((8, 3), 0.5, np.float32))
        return grow(cloud, num_candidates=100, generator=np.random.default_rng(0)).points

    def appended_to_an_empty_list(points):
        candidates = np.random.default_rng(0).uniform(-1, 1, (100, 3))
        kept = [c for c in candidates if np.linalg.norm(points - c, axis=1).min() < 0.01]
        return np.concatenate((points, np.array(kept)))

    fault(
        lambda grown: float(len(grown(corners)) != 8),
        ours=ours,
        emulation=appended_to_an_empty_list,
        raises=ValueError,
    )


@row("A0", "F15")
def test_f15_growth_does_not_depend_on_the_unit(fault):
    """Metres, millimetres, kilometres: the fraction of accepted candidates."""

    def ours(points):
        colors = np.zeros_like(points)
        return (
            len(
                grow(
                    PointCloud(points, colors),
                    num_candidates=20_000,
                    radius=0.05,
                    generator=np.random.default_rng(0),
                ).points
            )
            - 300
        )

    def absolute_radius(points):
        candidates = np.random.default_rng(0).uniform(points.min(0), points.max(0), (2000, 3))
        return sum(np.linalg.norm(points - c, axis=1).min() < 0.05 for c in candidates)

    def deviation(accepted):
        counts = np.array([accepted(ball().points * unit) for unit in (1e-3, 1.0, 1e3)])
        return np.ptp(counts) / counts.mean()

    fault(deviation, ours=ours, emulation=absolute_radius, at_most=0.01, unit="relative")


@row("A0", "F15")
@pytest.mark.parametrize("axes", [(0, 1), (2,), ()], ids=["flat", "needle", "point"])
def test_f15_a_degenerate_prior_does_not_explode(axes, fault):
    """Every candidate in the box of a flat cloud is near it, so only the cap limits their number;
    the emulation has none.
    """
    points = np.zeros((300, 3), np.float32)
    points[:, axes] = ball().points[:, axes]
    options = {"enabled": True, "num_candidates": 20_000, "radius": 0.9, "max_points": 500}

    def ours(points):
        return len(
            grow_points(
                PointCloud(points, np.zeros_like(points)), GaussianCloud({"grow": options}).cfg.grow
            ).points
        )

    def without_a_cap(points):
        candidates = np.random.default_rng(0).uniform(points.min(0), points.max(0), (2000, 3))
        return 300 + sum(np.linalg.norm(points - c, axis=1).min() < 0.9 for c in candidates)

    fault(
        lambda count: count(points), ours=ours, emulation=without_a_cap, at_most=800, unit="points"
    )


# ---- densifying ----------------------------------------------------------------------------------


def parameters(n: int) -> dict[str, torch.Tensor]:
    g = torch.Generator().manual_seed(0)
    shapes = {
        "means": (n, 3),
        "log_scales": (n, 3),
        "quats": (n, 4),
        "logit_opacities": (n,),
        "sh0": (n, 1, 3),
        "sh_rest": (n, 0, 3),
    }
    return {
        name: torch.randn(shape, generator=g) - 5.0 * (name == "log_scales")
        for name, shape in shapes.items()
    }


@row("A0", "F13")
def test_f13_one_gaussian_keeps_its_shape(fault):
    """Prunes no Gaussian. The emulation squeezes the (1, 1) mask to a scalar, which adds a
    dimension to what it indexes.
    """

    def ours(params):
        stats = Statistics(torch.zeros(1), torch.ones(1))
        rules = Rules(min_opacity=0.0, max_scale=1e9, min_gaussians=1)
        return densify.densify_and_prune(params, stats, rules, generator(0, "s")).values["means"]

    def squeezed(params):
        faint = (torch.sigmoid(params["logit_opacities"])[:, None] < 0).squeeze()
        return params["means"][~faint]

    def deviation(pruned):
        return float(pruned(parameters(1)).shape != (1, 3))

    fault(deviation, ours=ours, emulation=squeezed, unit="wrong shapes")


@row("A0", "F18")
def test_f18_densification_loses_no_step(fault):
    """Selecting no Gaussian must change nothing. The emulation replaces the rows between backward
    and step.
    """
    none_selected = {
        "enabled": True,
        "start": 1,
        "stop": 9,
        "every": 2,
        "min_opacity": 1e-9,
        "grad_threshold": 1e9,
        "max_scale": 1e9,
    }

    def step_first(geometry, optimizer, step):
        optimizer.step()
        DensityControl(geometry).after_step(optimizer, step)

    def densify_first(geometry, optimizer, step):
        if geometry.cfg.densify.enabled and step % 2 == 0:
            geometry.apply_change(DensityControl(geometry).densified(step), optimizer)
        optimizer.step()

    def trajectory(finish, **options):
        geometry = started(**options)
        optimizer = torch.optim.Adam(
            [{**group, "lr": 1e-2} for group in geometry.parameter_groups()]
        )
        for step in range(1, 7):
            sum((p**2).sum() for p in geometry.parameters()).backward()
            finish(geometry, optimizer, step)
            optimizer.zero_grad()
        return geometry.means.detach()

    plain = trajectory(step_first)
    fault(
        lambda f: (trajectory(f, densify=none_selected) - plain).abs().max(),
        ours=step_first,
        emulation=densify_first,
        unit="moved",
    )


@row("A0", "F21")
def test_f21_the_cap_takes_what_contributes_least(fault):
    contribution = torch.rand(500, generator=torch.Generator().manual_seed(1))
    best = contribution.sort(descending=True).values[:200].sum()

    def ours(params):
        stats = Statistics(torch.zeros(500), contribution)
        rules = Rules(max_gaussians=200, min_opacity=0.0, max_scale=1e9, min_gaussians=1)
        return densify.densify_and_prune(params, stats, rules, generator(0, "s")).parents

    def random_choice(params):
        return torch.randperm(500, generator=torch.Generator().manual_seed(0))[:200]

    def deviation(capped):
        kept = capped(parameters(500))
        return 1e9 if len(kept) != 200 else (1 - contribution[kept].sum() / best) * 100

    fault(deviation, ours=ours, emulation=random_choice, unit="% of the contribution lost")
