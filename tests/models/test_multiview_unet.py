"""MVDream's UNet: loaded from its published layout, with attention over the views of an object."""

import pytest
import torch

from tests.helpers import tiny_models
from tests.helpers.refusals import refused
from threestudio_gaussiandreamer.models import multiview_unet

diffusers = pytest.importorskip("diffusers")
VIEWS = 4


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tiny_models.mvdream(tmp_path_factory.mktemp("models") / "mvdream")


def load(folder, dtype=torch.float32):
    kind, options = diffusers.UNet2DConditionModel, {"half": False, "torch_dtype": dtype}
    return multiview_unet.load_multiview_unet(kind, folder, "unet", **options)


@torch.no_grad()
def predict(unet, z, text, cameras, t=500):
    times = torch.full((len(z),), t)
    return unet(z, times, encoder_hidden_states=text, class_labels=cameras).sample


def inputs(rows, seed=0):
    draw = torch.Generator().manual_seed(seed)
    shapes = ((rows, 4, 8, 8), (rows, 5, 32), (rows, 16))
    return [torch.randn(*shape, generator=draw) for shape in shapes]


def test_the_published_names_give_the_same_network(folder):
    mine = load(folder)
    original = tiny_models.plain_unet(multiview_unet.unet_options(tiny_models.MULTI_VIEW))
    for name, value in original.state_dict().items():
        assert torch.equal(mine.state_dict()[name], value), name
    z, text, cameras = inputs(3)
    assert torch.equal(predict(mine, z, text, cameras), predict(original, z, text, cameras))
    assert load(folder, torch.float16).dtype == torch.float16


def test_views_see_those_of_their_own_object_and_equal_ones_give_what_one_gives(folder):
    """Attention to four copies of each token has the weights of attention to one."""
    unet = load(folder)
    z, text, cameras = (values.repeat_interleave(VIEWS, 0) for values in inputs(2))
    alone = predict(unet, z, text, cameras)
    with multiview_unet.views_attended_together(unet, VIEWS):
        together = predict(unet, z, text, cameras)
    torch.testing.assert_close(together, alone, rtol=1e-5, atol=1e-5)
    with multiview_unet.views_attended_together(unet, 1):
        assert torch.equal(predict(unet, z, text, cameras), alone)
    assert not torch.allclose(predict(unet, z, text, cameras + 1), alone, atol=1e-3)
    unet = load(folder)
    multiview_unet.attend_across_views(unet, VIEWS)
    z, text, cameras = inputs(2 * VIEWS)
    before, order = predict(unet, z, text, cameras), [2, 0, 3, 1]
    turned = predict(unet, z[order], text[order], cameras[order])
    torch.testing.assert_close(turned, before[order], rtol=1e-5, atol=1e-5)
    z[1] += 1.0
    change = (predict(unet, z, text, cameras) - before).abs().amax(dim=(1, 2, 3))
    assert (change[:VIEWS] > 1e-3).all()
    assert (change[VIEWS:] < 1e-5).all()


def test_models_that_do_not_fit_are_reported(tmp_path):
    folder = tiny_models.mvdream(tmp_path / "other", model_channels=64)
    refused("(?s)unet of the model in .* can't .*size mismatch", load, folder)
    (folder / "unet" / "diffusion_pytorch_model.safetensors").write_bytes(b"no weights")
    refused("unet of the model in .* can't be loaded", load, folder)
