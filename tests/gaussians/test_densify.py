"""Cap, floor, and moments that follow their Gaussian through any sequence of changes."""

import torch
from torch import nn

from threestudio_gaussiandreamer.core.streams import generator
from threestudio_gaussiandreamer.gaussians import densify
from threestudio_gaussiandreamer.training.density import DensifyConfig


def cloud(n, seed=0, log_scale=-4.0):
    g = torch.Generator().manual_seed(seed)
    values = {
        "means": torch.randn(n, 3, generator=g),
        "log_scales": torch.full((n, 3), log_scale),
        "quats": torch.randn(n, 4, generator=g),
        "logit_opacities": torch.zeros(n),
        "sh0": torch.rand(n, 1, 3, generator=g),
    }
    return {name: nn.Parameter(value) for name, value in values.items()}


def densified(params, gradient=0.0, least=1, most=500_000, **rules):
    """Densify a cloud whose contribution grows with the index."""
    count = len(params["means"])
    gradient = torch.as_tensor(gradient).expand(count)
    statistics, rng = (gradient, torch.linspace(0, 1, count)), generator(0, "s")
    return densify.densify_and_prune(params, *statistics, DensifyConfig(**rules), least, most, rng)


def test_small_gaussians_are_cloned_and_large_ones_split_into_samples_of_them():
    params = cloud(4)
    params["log_scales"].data[2:] = -1.0  # larger than split_scale
    change = densified(params, [1.0, 0.0, 1.0, 0.0], split_scale=0.04, max_scale=10)
    assert sorted(change.parents.tolist()) == [0, 0, 1, 2, 2, 3]
    assert change.is_new.sum() == 3  # one clone, two children; the split one itself is gone
    children = (change.parents == 2).nonzero()[:, 0]
    expected = params["log_scales"][2] - torch.log(torch.tensor(densify.SPLIT_SHRINK))
    assert torch.allclose(change.values["log_scales"][children], expected.expand(2, 3))
    assert not torch.allclose(*change.values["means"][children])
    n, sizes = 4000, torch.tensor([0.5, 0.1, 0.02])
    one = {name: value[:1].detach() for name, value in cloud(1).items()}
    params = {name: value.repeat(n, *[1] * (value.ndim - 1)) for name, value in one.items()}
    params["log_scales"][:] = sizes.log()
    none = torch.zeros(n, dtype=torch.bool)
    change = densify.clone_and_split(params, clone=none, split=~none, rng=generator(0, "s"))
    offsets = change.values["means"] - params["means"][0]
    axes = torch.stack([densify.rotate(params["quats"][:1], e[None])[0] for e in torch.eye(3)])
    deviation = (offsets @ axes.T).std(0)
    assert torch.allclose(deviation, sizes, rtol=0.05)  # 8000 samples: 6 standard errors


def test_which_gaussians_are_dropped_and_their_room_is_used_in_the_same_round(caplog):
    params = cloud(6)
    params["logit_opacities"].data[0] = -5.0  # faint
    params["log_scales"].data[1, 2] = 0.0  # huge
    assert densified(params).parents.tolist() == [2, 3, 4, 5]
    unseen = densified(cloud(5))
    assert unseen.parents.tolist() == [0, 1, 2, 3, 4] and not unseen.is_new.any()
    densified(cloud(50), least=64)
    assert not caplog.records
    params = cloud(10)
    params["logit_opacities"].data[:3] = -5.0
    change = densified(params, torch.linspace(1, 2, 10), most=10)
    assert sorted(change.parents.tolist()) == [3, 4, 5, 6, 7, 7, 8, 8, 9, 9]


def test_the_threshold_means_the_same_at_any_resolution_batch_and_loss_scale():
    """Of a view's loss; its gradient in pixels is averaged and scaled."""
    device_units = torch.rand(1, 20, 2)
    pixels = device_units / torch.tensor([512 / 2, 256 / 2]) / 4 * 65536.0
    norms = densify.screen_gradients(pixels.repeat(4, 1, 1), 512, 256, 65536.0)
    assert torch.allclose(norms, device_units.norm(dim=-1).expand(4, -1), rtol=1e-5)
    assert (densify.screen_gradients(torch.full((1, 2, 2), float("nan")), 8, 8) == 0).all()


def test_state_with_one_number_a_gaussian_follows_it():
    params = {"means": nn.Parameter(torch.rand(5, 3))}
    optimizer = torch.optim.Adam([{"params": [params["means"]], "name": "means"}])
    rows, columns = torch.arange(5.0)[:, None], torch.ones(1, 3)  # as Adafactor's
    optimizer.state[params["means"]] = {"row_var": rows, "col_var": columns}
    parents = torch.tensor([4, 1])
    change = densify.Change(parents, torch.tensor([False, True]), {})
    new = {"means": nn.Parameter(params["means"].detach()[parents])}
    densify.update_optimizer(optimizer, params, new, change)
    state = optimizer.state[new["means"]]
    assert state["row_var"].tolist() == [[4.0], [0.0]] and state["col_var"] is columns
