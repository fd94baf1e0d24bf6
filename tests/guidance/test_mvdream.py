"""MVDream's guidance: four views of an object together, their cameras, one timestep for all."""

import pytest
import torch

from tests.helpers import tiny_large_guidance as tiny
from tests.helpers.refusals import refused
from tests.helpers.tiny_guidance import Recorder, relative, renders
from threestudio_gaussiandreamer.cameras import orbit_c2w
from threestudio_gaussiandreamer.guidance import base, mvdream

pytest.importorskip("diffusers")
KIND = "mvdream"


@pytest.fixture
def model(large):
    return large(KIND)[0]


@pytest.fixture
def prompts(large):
    return large(KIND)[1]


def ring(start=10.0, count=4, **changes):
    """Return ``count`` views around the object at one elevation."""
    turn = start + torch.arange(count) * 360.0 / count
    same = torch.ones(count)
    angles = {"elevation": 15 * same, "azimuth": turn, "camera_distances": 2.5 * same} | changes
    return tiny.views(**angles)


def first(batch, count):
    return {name: value[:count] for name, value in batch.items()}


def gradient(guide, prompt_utils, rgb, **options):
    return tiny.gradient(guide, prompt_utils, rgb, **(ring() | options))


def test_the_cameras_are_mvdreams():
    """An orbit with y up, turned by (x, y, z) -> (x, -z, y); the front is azimuth 90, at +x."""
    elevation, azimuth = torch.tensor([0.0, 15.0, -30.0]), torch.tensor([0.0, 70.0, -160.0])
    mine = mvdream.camera_matrices(orbit_c2w(elevation, azimuth, torch.tensor([1.0, 2.5, 4.0])))
    front = [0, 0, 1, 1, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 0, 1]
    assert mine[0].tolist() == pytest.approx(front, abs=1e-6)
    e, a = torch.deg2rad(elevation.double()), torch.deg2rad(azimuth.double() + 90)
    back = torch.stack([e.cos() * a.sin(), e.sin(), e.cos() * a.cos()], 1)
    right = torch.linalg.cross(torch.tensor([[0.0, 1.0, 0.0]]).double().expand(3, 3), back)
    right = right / right.norm(dim=1, keepdim=True)
    columns = torch.stack([right, torch.linalg.cross(back, right), back, back], 2)
    turned = torch.stack([columns[:, 0], -columns[:, 2], columns[:, 1]], 1)
    last = torch.tensor([0.0, 0.0, 0.0, 1.0]).double().expand(3, 1, 4)
    expected = torch.cat([turned, last], 1).flatten(1)
    torch.testing.assert_close(mine.double(), expected, rtol=0, atol=1e-6)


def test_the_network_gets_the_cameras_of_all_rows_and_one_timestep_per_object(model, prompts):
    guide = tiny.guidance(KIND, model)
    guide.unet = recorder = Recorder(guide.unet)
    rgb = torch.cat([renders(), renders(seed=1)]).detach().requires_grad_()
    batch = {
        name: torch.cat([value, other])
        for (name, value), other in zip(ring().items(), ring(55.0).values(), strict=True)
    }
    tiny.gradient(guide, prompts, rgb, **batch)
    (((_, t), options),) = recorder.calls
    assert torch.equal(options["class_labels"], mvdream.camera_matrices(batch["c2w"]).repeat(2, 1))
    assert options["encoder_hidden_states"].shape == (16, 77, 32)
    assert [len(set(group)) for group in t.reshape(-1, 4).tolist()] == [1] * 4
    assert t[0] != t[4] and torch.equal(t[:8], t[8:])


@pytest.mark.parametrize("share", [0.0, 0.5])
def test_the_gradient_towards_known_views_is_the_closed_form(model, prompts, share):
    """One latent per view, of zero width: with the weight "x0" the gradient is x - x1."""
    targets = torch.randn(4, 4, 8, 8, generator=torch.Generator().manual_seed(1))
    cameras = mvdream.camera_matrices(ring()["c2w"])
    options = {"guidance_scale": 1.0, "min_step_percent": 0.2, "recon_std_rescale": share}
    guide = tiny.guidance(KIND, model, **options)

    def exact(z, t, class_labels, **conditions):
        view = torch.cdist(class_labels, cameras).argmin(1)
        abar = guide.alphas_cumprod[t][:, None, None, None]
        return ((z - abar.sqrt() * targets[view]) / (1 - abar).sqrt()).float()

    guide.unet = tiny.StandIn(guide.unet, exact)
    latents = torch.randn(4, 8, 8, 4, generator=torch.Generator().manual_seed(2)).requires_grad_()
    mine, _ = gradient(guide, prompts, latents, rgb_as_latents=True)
    expected = (latents.detach().double() - targets.movedim(1, -1)) / 4
    assert relative(mine, expected) < 1e-5
    assert relative(mine, expected[[2, 0, 3, 1]]) > 0.1, "views could be exchanged"


def test_a_single_view_is_alone_and_parts_of_a_group_are_refused(model, prompts, monkeypatch):
    """With one view per group the network is that of the view alone."""
    monkeypatch.setattr(base, "EVAL_STEPS", 2)
    guides = [tiny.guidance(KIND, model, n_view=count) for count in (4, 1)]
    pictures = [
        guide(renders(1), prompts, **first(ring(), 1), guidance_eval=True)["eval"]["imgs_final"]
        for guide in guides
    ]
    assert pictures[0].shape == (1, 64, 64, 3)
    torch.testing.assert_close(*pictures, rtol=1e-3, atol=1e-3)
    said = "sees 4 views .*together, and a batch has 3: set data.n_view=4"
    refused(said, guides[0], renders(3), prompts, **first(ring(), 3))
    pytest.importorskip("accelerate")
    found, saving = [], ("enable_attention_slicing", "enable_sequential_cpu_offload")
    for options in ({}, dict.fromkeys(saving, True)):
        guide = tiny.guidance(KIND, model, **options)
        guide.unet.double()
        guide.dtype = torch.float64
        found.append(gradient(guide, prompts, renders())[0])
    assert relative(found[1], found[0].double()) < 1e-5
