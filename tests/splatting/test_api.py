"""The public function: what it accepts and rejects, its messages, and the choice of the backend."""

import logging

import pytest
import torch

from tests.helpers.refusals import refused
from tests.helpers.splatting_scenes import NAMES, cameras, random_cloud
from threestudio_gaussiandreamer.core.errors import UserError
from threestudio_gaussiandreamer.splatting import (
    PRESETS,
    available_backends,
    backends,
    rasterize,
    torch_backend,
)
from threestudio_gaussiandreamer.splatting.cpu import backend as cpu


def arguments(n=6, views=2, dtype=torch.float32):
    viewmats, Ks = cameras(views, 10, 8)
    view = {"viewmats": viewmats.to(dtype), "Ks": Ks.to(dtype), "width": 10, "height": 8}
    return random_cloud(n).to(dtype)._asdict() | view


def call(**changes):
    options = {"backend": "torch"} | arguments() | changes
    positional = [options.pop(name) for name in (*NAMES, "viewmats", "Ks", "width", "height")]
    return rasterize(*positional, **options)


def usable():
    return [name for name, reason in available_backends().items() if reason is None]


def test_shapes_of_the_outputs_and_layouts_and_types_that_are_converted():
    out = call(downsample=2)
    shapes = {name: tuple(getattr(out, name).shape) for name in out._fields}
    images = {"image": (2, 4, 5, 3), "alpha": (2, 4, 5, 1), "depth": (2, 4, 5, 1)}
    assert shapes == images | {"means2d": (2, 6, 2), "radii": (2, 6), "contribution": (2, 6)}
    assert not out.radii.requires_grad and not out.contribution.requires_grad
    with torch.no_grad():
        out = call(means=arguments()["means"].requires_grad_())
    assert not out.image.requires_grad and not out.means2d.requires_grad
    values = arguments(dtype=torch.float64) | {"viewmats": arguments()["viewmats"]}
    assert call(**values, backend="auto").image.dtype == torch.float64
    values = arguments()
    tensors = {name: x for name, x in values.items() if torch.is_tensor(x) and x.dim() > 1}
    strided = {name: x.mT.contiguous().mT for name, x in tensors.items()}
    assert torch.equal(call(**strided).image, call(**values).image)
    for name in PRESETS:
        assert torch.equal(call(preset=name).image, call(alpha_min=PRESETS[name]).image)


@pytest.mark.parametrize(
    "changes, words",
    [
        ({"quats": torch.zeros(6, 3)}, ["quats", "(6, 4)", "(6, 3)"]),
        ({"scales": torch.zeros(5, 3)}, ["scales", "(6, 3)", "(5, 3)"]),
        ({"means": torch.zeros(())}, ["means", "(N, 3)", "single number"]),
        ({"colors": torch.zeros(3, 6, 3)}, ["colors", "(2, 6, 3)", "(3, 6, 3)"]),
        ({"colors": torch.zeros(6, 0)}, ["colour channel", "(6, 0)"]),
        ({"viewmats": torch.zeros(2, 3, 4)}, ["viewmats", "(2, 4, 4)", "(2, 3, 4)"]),
        ({"viewmats": torch.zeros(0, 4, 4), "Ks": torch.zeros(0, 3, 3)}, ["view"]),
        ({"Ks": torch.zeros(3, 3)}, ["Ks", "(2, 3, 3)", "(3, 3)"]),
        ({"background": torch.zeros(4)}, ["background", "(3,)", "(4,)"]),
        ({"background": [0.0, 0, 0]}, ["background", "Tensor", "list"]),
        ({"quats": torch.zeros(6, 4, dtype=torch.int64)}, ["quats", "floating point", "int64"]),
        ({"scales": torch.zeros(6, 3, dtype=torch.float64)}, ["scales", "float64"]),
        ({"quats": torch.zeros(6, 4, device="meta")}, ["quats", "device", "meta"]),
        ({"means": torch.zeros(6, 3, device="meta")}, ["means", "meta", "no values"]),
        ({"height": 8.0}, ["height", "8.0"]),
        ({"width": True}, ["width", "True"]),
        ({"height": 2_100_000}, ["height", "at most 1048560"]),
        ({"width": 9, "downsample": 2}, ["downsample", "9"]),
        ({"downsample": 3}, ["downsample", "3"]),
        ({"downsample": 2.0}, ["downsample", "2.0"]),
        ({"preset": "balancd"}, ["preset", "'balanced'"]),
        ({"backend": "torhc"}, ["backend", "'torch'"]),
        ({"non_finite": "ignore"}, ["non_finite", "drop", "error"]),
        ({"near": 0.0}, ["near", "0 < near"]),
        ({"near": 2.0, "far": 1.0}, ["near", "far"]),
        ({"far": None}, ["far", "number", "None"]),
        ({"alpha_min": "small"}, ["alpha_min", "number", "small"]),
        ({"eps2d": -0.1}, ["eps2d", "-0.1"]),
        ({"alpha_min": 1.5}, ["alpha_min", "1.5"]),
        ({"alpha_max": 1e-4}, ["alpha_max", "0.0001"]),
        ({"stop": -1.0}, ["stop", "-1.0"]),
        ({"stop": float("nan")}, ["stop", "nan"]),
    ],
    ids=lambda x: "-".join(x) if isinstance(x, dict) else "",
)
def test_mistakes_are_named(changes, words):
    with pytest.raises(UserError) as caught:
        call(**changes)
    assert all(word in str(caught.value) for word in words), caught.value


@pytest.mark.parametrize("name", ["viewmats", "Ks", "background"])
def test_non_finite_error_names_attribute_count_and_place(name):
    changes = arguments() | {"background": torch.zeros(2, 3)}
    value = changes[name].clone()
    value.flatten()[3:5] = float("nan")
    place = str(tuple((~value.isfinite()).nonzero()[0].tolist()))
    with pytest.raises(UserError) as caught:
        call(**{"background": changes["background"], name: value}, non_finite="error")
    assert all(word in str(caught.value) for word in (name, " 2 ", place, "nan"))


@pytest.mark.parametrize("only", ["colors", "opacities", "background"])
@pytest.mark.parametrize("backend", list(backends.BACKENDS))
def test_means2d_has_a_gradient_if_any_input_has(only, backend):
    if backend not in usable():
        pytest.skip(available_backends()[backend])
    changes = arguments() | {"background": torch.zeros(3)}
    value = changes[only].clone().requires_grad_()
    out = call(**{only: value}, backend=backend, absgrad=True)
    out.image.square().sum().backward()
    assert out.means2d.grad.shape == out.means2d.absgrad.shape == (2, 6, 2)
    assert (out.means2d.absgrad >= out.means2d.grad.abs() - 1e-7).all()
    assert out.means2d.grad.abs().sum() > 0


def test_an_unavailable_backend_says_why_and_auto_says_it_once(monkeypatch, caplog):
    refused("(?s)float32.*float64", call, **arguments(dtype=torch.float64), backend="cpu")
    monkeypatch.setattr(cpu, "unavailable", lambda: "the library wasn't built")
    refused("(?s)'cpu'.*the library wasn't built.*torch", call, backend="cpu")
    chosen = []
    for module, name in ((cpu, "cpu"), (torch_backend, "torch")):
        monkeypatch.setattr(module, "rasterize", lambda *_, name=name: chosen.append(name))
    monkeypatch.setattr(cpu, "unavailable", lambda: None)
    call(backend="auto")
    call(**arguments(dtype=torch.float64), backend="auto")
    assert chosen == ["cpu", "torch"] and not caplog.records

    monkeypatch.setattr(cpu, "unavailable", lambda: "no compiler was found")
    backends._warn_once.cache_clear()
    with caplog.at_level(logging.WARNING):
        call(backend="auto"), call(backend="auto")
    assert chosen[2:] == ["torch"] * 2
    (record,) = caplog.records
    assert "no compiler was found" in record.getMessage()
    backends._warn_once.cache_clear()


@pytest.mark.parametrize(
    ("name", "value", "said"),
    [("scales", -2.0, "exp"), ("opacities", 3.0, "sigmoid"), ("opacities", -1.0, "sigmoid")],
)
def test_logarithms_and_logits_are_refused(name, value, said):
    values = arguments()[name].clone()
    values.view(-1)[-1] = value
    for _ in range(2):
        refused(f"{name} must be .*got {value:g}: pass {said}", call, **{name: values})
    values.view(-1)[0] = torch.inf  # drops its Gaussian; it isn't out of the range
    call(**{name: values.clamp_min(0).where(values.isinf(), values.clamp(0, 1))})
