"""The regularisers of the renders, against values computed by hand."""

import math
from types import SimpleNamespace

import pytest
import torch

from tests.helpers.refusals import refused
from threestudio_gaussiandreamer.core.errors import UserError
from threestudio_gaussiandreamer.host import register
from threestudio_gaussiandreamer.training.losses import (
    check_losses,
    loggable,
    regularisers,
    require_gradients,
    total,
    total_variation,
    weighted_losses,
)


def own(function, name="own"):
    """Register a regulariser under a name of these tests, in place of that of an earlier test."""
    function.__module__, function.__qualname__ = __name__, name
    register(f"{name}-regulariser")(function)


def test_each_regulariser_is_weighted_and_computed_only_where_it_has_a_weight():
    ours = {name: regularisers()[name] for name in ("sparsity", "opaque", "tv")}
    out = {"opacity": torch.full((1, 4, 4, 1), 0.5), "comp_rgb": torch.rand(1, 4, 4, 3)}
    out = {name: picture.requires_grad_() for name, picture in out.items()}
    guided = {"loss_sds": torch.tensor(2.0), "grad_norm": torch.tensor(1.0)}
    weights = {"sds": 0.5, **dict.fromkeys(ours, 3.0)}
    losses = weighted_losses(guided, out, weights)
    assert float(losses.pop("sds")) == 1.0
    assert losses == {name: 3 * call(out) for name, call in ours.items()}
    assert losses["sparsity"].item() == pytest.approx(3 * math.sqrt(0.26))
    assert float(losses["opaque"]) == pytest.approx(3 * math.log(2))
    assert set(weighted_losses(guided, {}, {"sds": 1.0, "tv": 0.0, "foo": 0})) == {"sds"}
    image = torch.zeros(1, 4, 5, 3)
    image[:, :, 2:] = 0.5  # one of the four differences of a row is at the edge
    assert float(total_variation({"comp_rgb": image})) == pytest.approx(0.5 / 4)


def test_losses_without_a_gradient_and_names_that_are_taken_are_named():
    with_one = torch.ones(2, requires_grad=True).sum()
    assert total({"sds": with_one, "off": torch.tensor(0.0)}).requires_grad
    with pytest.raises(UserError, match="loss_sds, loss_off has no gradient"):
        total({"sds": with_one.detach(), "off": torch.tensor(0.0)})
    refused("^loss_sds has no gradient", total, {"sds": with_one.detach(), "tv": with_one})
    cloud, other = torch.nn.Linear(2, 1), torch.nn.Parameter(torch.ones(()))
    losses = {"sds": other * 2}
    losses["sds"].backward()
    refused("no gradient of loss_sds reaches the Gaussians", require_gradients, cloud, losses)
    cloud(torch.ones(2)).sum().backward()
    require_gradients(cloud, losses)
    own(lambda out: out["comp_rgb"].mean(), "shared")
    with pytest.raises(UserError, match="shared-regulariser has the name of the guidance's loss_s"):
        weighted_losses({"loss_shared": torch.ones(())}, {}, {"shared": 1})
    with pytest.raises(UserError, match="the name 'tv-regulariser' is taken by .*total_variation"):
        own(lambda out: out["comp_rgb"].mean(), "tv")


def test_logged_numbers_of_a_guidance_and_weights_of_zero_alone():
    guided = {"loss_sds": torch.tensor(2.0), "grad_norm": 1.0, "error_to_truth": 0.25}
    guided["pictures"] = torch.zeros(2, 3)
    numbers = loggable(guided, {"sds": torch.tensor(4.0)})
    assert numbers == {"train/grad_norm": 1.0, "train/loss_sds": 4.0}
    with pytest.raises(UserError, match="system.loss: every weight is 0"):
        check_losses(SimpleNamespace(LOSSES=("sds",)), {"lambda_sds": 0, "lambda_tv": None})
    check_losses(SimpleNamespace(LOSSES=("sds",)), {"lambda_sds": 0, "lambda_tv": 1.0})
    own(torch.nn.Identity)
    with pytest.raises(UserError, match="own-regulariser is a class; register a function"):
        check_losses(SimpleNamespace(LOSSES=("sds",)), {"lambda_sds": 1, "lambda_own": 1.0})


@pytest.mark.parametrize(
    ("value", "said"), [(torch.ones(2), r"\(2,\)"), (0.5, "float"), (None, "NoneType")]
)
def test_an_own_regulariser_returns_one_number(value, said):
    own(lambda out: value)
    with pytest.raises(UserError, match=f"own-regulariser returned {said}; expected one number"):
        weighted_losses({"loss_sds": torch.ones(())}, {}, {"sds": 1, "own": 2})
