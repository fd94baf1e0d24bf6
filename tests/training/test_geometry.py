"""The cloud: its start from points, its size, its rates, its checkpoint; the preflight of parts."""

from dataclasses import dataclass
from types import SimpleNamespace

import pytest
import torch

from tests.helpers.refusals import refused
from threestudio_gaussiandreamer import cameras, register_parts
from threestudio_gaussiandreamer.core.errors import UserError
from threestudio_gaussiandreamer.core.files import existing_file
from threestudio_gaussiandreamer.formats.gaussian_files import StoredCloud, write_cloud
from threestudio_gaussiandreamer.gaussians import densify, grow, sh
from threestudio_gaussiandreamer.gaussians.gaussians import Gaussians
from threestudio_gaussiandreamer.host import BaseGeometry, BaseObject, find, register
from threestudio_gaussiandreamer.training.density import DensityControl
from threestudio_gaussiandreamer.training.geometry import GaussianCloud, grow_points
from threestudio_gaussiandreamer.training.system import preflight_parts

register_parts()
NO_GROWTH = {"enabled": False}


def started(cloud, **cfg):
    geometry = GaussianCloud({"grow": NO_GROWTH, **cfg})
    geometry.start_from(grow_points(cloud, geometry.cfg.grow))
    return geometry


def test_each_point_becomes_one_gaussian_whose_rates_follow_their_schedules(sphere_points):
    geometry = started(sphere_points)
    assert len(geometry) == 400
    assert torch.equal(geometry.means, torch.from_numpy(sphere_points.points))
    assert torch.allclose(geometry.opacities(), torch.tensor(0.1))
    colors = torch.from_numpy(sphere_points.colors)
    assert torch.allclose(geometry.colors(torch.zeros(1, 3)), colors, atol=1e-6)
    nearest = torch.from_numpy(grow.nearest_distance_scales(sphere_points.points, "nearest"))
    assert torch.allclose(geometry.scales(), nearest[:, None].expand(-1, 3), rtol=1e-5)
    assert torch.equal(geometry.quats, torch.tensor([1.0, 0, 0, 0]).expand(400, 4))
    geometry = started(sphere_points, lr_means=[0, 2e-4, 1e-4, 100], lr_sh_rest=0.5, sh_degree=1)
    optimizer = torch.optim.Adam(geometry.parameter_groups())
    geometry.set_learning_rates(optimizer, 0, 50)
    rates = {group["name"]: group["lr"] for group in optimizer.param_groups}
    assert rates["means"] == pytest.approx(1.5e-4) and rates["sh_rest"] == 0.5
    assert rates["log_scales"] == 1e-3 and len(rates) == 6


def test_the_object_grows_first_and_the_ground_is_added_then():
    """The wider ground would enlarge the box and the radius, and would grow itself."""
    prior = {"num_points": 400, "size": 0.7}
    options = {"prior_type": "random-prior", "grow": {"num_candidates": 20_000, "radius": 0.04}}
    ground = {"ground": True, "ground_points": 100, "ground_size": 3.0}
    priors = prior, prior | ground
    alone, with_ground = (GaussianCloud({**options, "prior": each}) for each in priors)
    for geometry in (alone, with_ground):
        geometry.initialize("a fox")
    assert len(alone) > 500
    assert torch.equal(with_ground.means[:-100], alone.means)
    assert torch.equal(with_ground.sh0[:-100], alone.sh0)
    bottom = alone.means[:400, 2].min()
    assert torch.equal(with_ground.means[-100:, 2], bottom.expand(100))


def test_harmonics_are_padded_and_cut_and_see_the_direction_from_the_camera(sphere_points):
    third = started(sphere_points, sh_degree=3)
    assert third.sh.shape == (400, 16, 3) and third.sh_rest.abs().sum() == 0
    third.sh_rest.data.normal_()
    first = GaussianCloud({"sh_degree": 1})
    first.set_arrays(**Gaussians.of(third).map(torch.Tensor.detach)._asdict())
    assert torch.equal(first.sh, third.sh[:, :4])
    assert third.colors(torch.randn(2, 3)).shape == (2, 400, 3)
    geometry = started(sphere_points, sh_degree=1)
    geometry.sh_rest.data.normal_()
    camera = torch.tensor([[0.0, 0.0, 5.0]])
    dirs = torch.nn.functional.normalize(geometry.means - camera, dim=-1)
    seen = sh.sh_to_colors(geometry.sh, dirs)
    assert seen.max() > 1.5
    assert torch.allclose(geometry.colors(camera)[0], seen.clamp_max(1), atol=1e-6)
    geometry.cfg.bound_colors = False
    assert torch.allclose(geometry.colors(camera)[0], seen, atol=1e-6)


@pytest.mark.parametrize("unit", ["world", "size"])
def test_a_step_moves_means_in_the_unit_of_their_rate(sphere_points, unit):
    geometry = started(sphere_points, lr_means_unit=unit)
    for parameter in (geometry.quats, geometry.log_scales, geometry.means):
        torch.nn.init.normal_(parameter, generator=torch.Generator().manual_seed(0))
    before, gradient = geometry.means.detach().clone(), torch.randn(len(geometry), 3)
    geometry.means.grad = gradient.clone()
    with geometry.steps_by_size():
        torch.optim.SGD([geometry.means], lr=0.5).step()
    quats, axes = geometry.quats.detach(), torch.eye(3)
    columns = [densify.rotate(quats, axis.expand(len(quats), 3)) for axis in axes]
    scaled = torch.stack(columns, -1) * geometry.scales().detach()[:, None]
    wanted = gradient[..., None]
    if unit == "size":
        wanted = scaled @ (scaled.transpose(1, 2) @ wanted)
    assert torch.allclose(geometry.means, before - 0.5 * wanted[..., 0], atol=1e-4, rtol=1e-4)


@pytest.mark.parametrize("absgrad", [False, True])
def test_the_rasteriser_collects_absolute_gradients_where_they_decide(sphere_points, absgrad):
    options = {"enabled": True, "absgrad": absgrad}
    geometry = started(sphere_points, densify=options, init_opacity=0.5)
    parts = {"geometry": geometry, "material": None}
    parts["background"] = find("gaussiandreamer-background")({"color": [1.0, 1.0, 1.0]})
    c2w = cameras.orbit_c2w(torch.zeros(2), torch.tensor([0.0, 90.0]), torch.full((2,), 2.5))
    out = find("gaussiandreamer-splatting")({}, **parts)(c2w, torch.full((2,), 0.8), 40, 24)
    (out["comp_rgb"] ** 2).mean().backward()
    DensityControl(geometry).after_backward(out["rasterized"], 40, 24)
    means2d = out["rasterized"].means2d
    assert hasattr(means2d, "absgrad") == absgrad
    expected = densify.screen_gradients(means2d.absgrad if absgrad else means2d.grad, 40, 24).sum(0)
    assert torch.equal(geometry.gradient_sum, expected) and expected.max() > 0


@pytest.mark.parametrize("degree, told", [(0, True), (2, False)])
def test_colours_that_are_dropped_are_told(sphere_points, tmp_path, caplog, degree, told):
    trained = started(sphere_points, sh_degree=2)
    trained.sh_rest.data[:, 5] = 0.1  # of degree 2
    write_cloud(str(tmp_path / "a.ply"), StoredCloud(Gaussians.of(trained).arrays()))
    prior = {"prior_type": "gaussians-prior", "prior": {"path": str(tmp_path / "a.ply")}}
    geometry = GaussianCloud({**prior, "sh_degree": degree})
    geometry.initialize("anything")
    assert (f"system.geometry.sh_degree={degree} drops the bands" in caplog.text) == told
    assert geometry.sh_rest.shape[1] == (degree + 1) ** 2 - 1
    for name in ("means", "log_scales", "quats", "logit_opacities", "sh0"):
        assert torch.equal(getattr(geometry, name), getattr(trained, name)), name


@pytest.mark.parametrize(
    "wrong, named",
    [
        ({"scale_rule": "nearst"}, "nearest"),
        ({"init_opacity": 1.0}, "init_opacity"),
        ({"grow": {"radius": 1e38}}, "grow.radius"),
        ({"lr_means": 1e30}, "lr_means: expected values of 1e\\+06 or less"),
        ({"grow": {"color_range": [0.2, 0.0]}}, "color_range"),
        ({"lr_means": [1, 2, 3, 4, 5]}, "lr_means"),
    ],
)
def test_a_value_out_of_range_is_named(wrong, named):
    refused(named, GaussianCloud, wrong)


def test_an_empty_cloud_and_a_geometry_without_gaussians_are_refused(sphere_points):
    empty = find("gaussiandreamer-cloud")({})
    refused("is empty.*system_type must be gaussiandreamer-system", empty.do_update_step, 0, 0)
    empty.do_update_step(0, 0, on_load_weights=True)
    started(sphere_points).do_update_step(0, 0)
    for part in ("gaussiandreamer-splatting", "mesh-exporter"):
        with pytest.raises(UserError, match="BaseGeometry is no cloud of Gaussians: it has no"):
            made = find(part)({}, geometry=BaseGeometry({}), material=None, background=None)
            made()


@register("test-weights-guidance")
class WeightsGuidance(BaseObject):
    @dataclass
    class Config(BaseObject.Config):
        weights: str = "missing.bin"

    @classmethod
    def preflight(cls, cfg):
        existing_file(cfg.weights, "weights")


@register("test-instance-preflight-guidance")
class InstancePreflight(WeightsGuidance):
    def preflight(self):
        """Take no options."""


WRONG = {
    "^system.guidance: weights 'missing.bin' does not exist": ("test-weights-guidance", {}),
    "InstancePreflight.preflight needs @classmethod": ("test-instance-preflight-guidance", {}),
    "^system.guidance: mesh 'no.glb' does not exist": ("exact-score-guidance", {"mesh": "no.glb"}),
    "^system.guidance: unknown mesh format of": ("exact-score-guidance", {"mesh": __file__}),
}


@pytest.mark.parametrize("message", WRONG)
def test_what_a_guidance_lacks_is_named_before_any_folder_is_made(message, tmp_path, monkeypatch):
    """Also of options that aren't given, and after what the prior lacks."""
    monkeypatch.chdir(tmp_path)
    prompts = "gaussiandreamer-stable-diffusion-prompt-processor"
    cfg = SimpleNamespace(prompt_processor_type=prompts, prompt_processor={"prompt": "lib:a"})
    cfg.guidance_type, cfg.guidance = WRONG[message]
    refused(message, preflight_parts, GaussianCloud({}), cfg)
    if "Instance" not in message:
        cloud = GaussianCloud({"prior_type": "mesh-prior", "prior": {"path": "no.glb"}})
        refused("^system.geometry.prior: mesh 'no.glb' does not exi", preflight_parts, cloud, cfg)
    assert not [*tmp_path.iterdir()]
