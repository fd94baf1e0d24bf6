"""The first use of the CUDA kernels on a device: compared with plain torch, in emulation."""

import ctypes
import functools
import logging
import re

import pytest
import torch

from tests.helpers.broken_kernels import DEFAULT, FAULTS, BrokenDevice, Fault, other_constants
from tests.helpers.cuda_shim.device import HostDevice, library, needs_nvrtc, unavailable
from tests.helpers.splatting_scenes import cameras, random_cloud, rasterize
from threestudio_gaussiandreamer.core.errors import UserError
from threestudio_gaussiandreamer.splatting import backends
from threestudio_gaussiandreamer.splatting.cuda import driver, nvrtc, proof
from threestudio_gaussiandreamer.training.renderer import check_backend

pytestmark = pytest.mark.skipif(unavailable() is not None, reason=str(unavailable()))
CPU = torch.device("cpu")


class CompilingDevice(HostDevice):
    """Compiles each kernel before it is run, as a GPU does."""

    def launch(self, name: str, grid: tuple[int, int], threads: int, *arguments) -> None:
        nvrtc.machine_code(driver.UNITS[name], "sm_90")
        super().launch(name, grid, threads, *arguments)


class NamedDevice(HostDevice):
    """Describes itself as a GPU does."""

    index, target = 0, "sm_90"
    describe = driver.Gpu.describe


@pytest.fixture
def use(monkeypatch, tmp_path):
    """Let "auto" find a GPU, on the CPU; returns a function that begins a new start with another
    device.
    """
    monkeypatch.setenv("GAUSSIANDREAMER_CACHE", str(tmp_path / "cubins"))
    cuda = backends.Backend(proof.kernels, ("cpu",), (torch.float32,), proof)
    found = {"cuda": cuda, "torch": backends.BACKENDS["torch"]}
    monkeypatch.setattr(backends, "BACKENDS", found)
    monkeypatch.setattr(driver, "unavailable", lambda: None)

    def begin(device: HostDevice) -> HostDevice:
        monkeypatch.setattr(driver, "device", lambda _: device)
        proof.failure.cache_clear()
        backends._warn_once.cache_clear()
        return device

    yield begin
    proof.failure.cache_clear()


def picture(backend: str = "auto") -> torch.Tensor:
    cloud = random_cloud(20, seed=1).to(torch.float32)
    camera = cameras(1, 12, 12, dtype=torch.float32)
    return rasterize(*cloud, *camera, 12, 12, backend=backend).image


def warnings(caplog) -> list[str]:
    """Return the warnings; a launch in the same process lets compilations be logged too."""
    return [record.getMessage() for record in caplog.records if record.levelno >= logging.WARNING]


def test_right_kernels_are_used_and_compared_once(use):
    device = use(HostDevice())
    image = picture()
    assert device.launched.count("blend") == len(proof.OPTIONS) + 1
    assert set(device.launched) == set(driver.UNITS)
    assert torch.equal(image, picture("cuda"))
    assert device.launched.count("blend") == len(proof.OPTIONS) + 2
    again = use(HostDevice())  # the verdict is read from the cache
    assert torch.equal(image, picture()) and again.launched.count("blend_backward") == 0


def test_right_kernels_are_far_from_the_tolerance(use):
    use(HostDevice())
    errors = proof.relative_errors(proof.drawn_on(CPU), proof.reference())
    assert max(max(sizes.values()) for sizes in errors.values()) < proof.TOLERANCE / 10
    assert [len(sizes) for sizes in errors.values()] == [11, 11, 12]


QUICK = ("project", "list_tiles", "blend", "project_backward", "sums of absolute values")


@pytest.mark.parametrize(
    "fault",
    [
        pytest.param(fault, id=name, marks=() if name in QUICK else pytest.mark.slow)
        for name, fault in FAULTS.items()
    ],
)
def test_a_broken_kernel_means_plain_torch_and_one_warning(use, caplog, fault):
    use(BrokenDevice(fault))
    assert torch.equal(picture(), picture("torch"))
    picture()
    (warning,) = warnings(caplog)
    assert "its kernels differ from plain torch: " in warning
    assert tuple(draw for draw in proof.OPTIONS if f"with {draw}, " in warning) == fault.draws
    assert "[the stand-in, torch " in warning and "Please report this message" in warning
    with pytest.raises(UserError, match="'cuda' can't run: .*differ from plain torch"):
        picture("cuda")


def test_broken_kernels_are_refused_before_a_run_begins(use):
    use(BrokenDevice(FAULTS["blend"]))
    with pytest.raises(UserError, match="a.backend: cuda can't be used here: .*differ from plain"):
        check_backend("a.backend", "cuda")
    check_backend("a.backend", "auto")
    use(HostDevice())
    check_backend("a.backend", "torch")


def test_the_verdict_about_broken_kernels_is_cached_until_its_file_is_removed(use, tmp_path):
    use(BrokenDevice(FAULTS["blend"]))
    picture()
    mended = use(HostDevice())
    assert torch.equal(picture(), picture("torch")) and not mended.launched
    (verdict,) = (tmp_path / "cubins").iterdir()
    with pytest.raises(UserError, match=f"delete {verdict} and start again"):
        picture("cuda")
    verdict.unlink()
    use(mended)
    picture()
    assert "blend" in mended.launched


DRIVERS = {
    None: "driver of CUDA 13.0",
    "NVRM version: NVIDIA UNIX x86_64 Kernel Module  570.86.15  Fri\nGCC version:  13.3.0\n": (
        "driver 570.86.15 of CUDA 13.0"
    ),
    "NVRM version: NVIDIA UNIX Open Kernel Module for aarch64  580.65.06  Release\n": (
        "driver 580.65.06 of CUDA 13.0"
    ),
    "of an unknown form": "driver of CUDA 13.0",
}


def test_another_driver_is_compared_again(use, monkeypatch, tmp_path):
    """Of the same CUDA release; without its own version the release counts."""
    monkeypatch.setattr(torch.cuda, "get_device_name", lambda _: "a GPU")
    monkeypatch.setattr(driver, "driver_version", lambda: (13, 0))
    monkeypatch.setattr(nvrtc, "version", lambda: (13, 0))
    monkeypatch.setattr(driver, "VERSION_FILE", tmp_path / "version")
    compared, known = [], set()
    for text, expected in DRIVERS.items():
        (tmp_path / "version").unlink(missing_ok=True)
        if text is not None:
            (tmp_path / "version").write_text(text)
        device = use(NamedDevice())
        assert device.describe() == f"a GPU, sm_90, {expected}, NVRTC of CUDA 13.0"
        assert proof.failure(CPU) is None
        compared.append(bool(device.launched))
        assert compared[-1] == (expected not in known)
        known.add(expected)
    assert compared == [True, True, True, False]


def test_a_nan_is_a_difference(use):
    nan = functools.partial(other_constants, eps2d=float("nan"))
    use(BrokenDevice(Fault("project_backward", nan)))
    with pytest.raises(UserError, match="with default options, gradient of means by nan"):
        picture("cuda")


@pytest.mark.parametrize(
    "error", [UserError("CUDA failed at launching the kernel blend"), RuntimeError("CUDA error")]
)
def test_a_failed_launch_means_plain_torch(use, caplog, error):
    use(BrokenDevice(FAULTS["blend"], error))
    assert torch.equal(picture(), picture("torch"))
    assert f"its kernels fail on a small scene: {error}" in caplog.text


@needs_nvrtc
def test_a_failed_compilation_means_plain_torch(use, caplog, monkeypatch):
    """The reason is cached, since the key has the source text and the compiler's release."""
    texts = {"blend": "void f() { undeclared = 1; }"}
    source = nvrtc.source
    monkeypatch.setattr(nvrtc, "source", lambda unit: texts.get(unit) or source(unit))
    monkeypatch.setattr(driver, "UNITS", dict.fromkeys(driver.UNITS, "blend"))
    use(CompilingDevice())
    assert torch.equal(picture(), picture("torch"))
    (warning,) = warnings(caplog)
    assert "its kernels fail on a small scene: the NVRTC of CUDA " in warning
    assert "can't compile blend.cu for sm_90" in warning and '"undeclared" is undefined' in warning
    assert "[the stand-in, torch " in warning and "Please report this message" in warning
    use(HostDevice())
    with pytest.raises(UserError, match="'cuda' can't run: .*can't compile blend.cu"):
        picture("cuda")


def missing_library() -> ctypes.CDLL:
    return ctypes.CDLL("/no/such/libnvrtc.so")


def library_without_functions() -> ctypes.CDLL:
    return ctypes.CDLL(library()._name)


@pytest.mark.parametrize(
    ("device", "load", "message"),
    [
        (CompilingDevice, missing_library, "OSError: /no/such/libnvrtc.so"),
        (NamedDevice, library_without_functions, "AttributeError: .*undefined symbol: nvrtc"),
    ],
)
def test_a_library_that_fails_means_plain_torch_until_the_next_start(
    use, caplog, monkeypatch, tmp_path, device, load, message
):
    """At the first kernel, and before the GPU's name is known."""
    monkeypatch.setattr(torch.cuda, "get_device_name", lambda _: "a GPU")
    monkeypatch.setattr(driver, "driver_version", lambda: (13, 0))
    use(device())
    with monkeypatch.context() as patch:
        patch.setattr(nvrtc, "_library", load)
        assert torch.equal(picture(), picture("torch"))
        (warning,) = warnings(caplog)
        gpu = "unknown GPU" if device is NamedDevice else "the stand-in"
        expected = rf"its compiler or the driver can't be used: {message}.* \[{gpu}, torch "
        assert re.search(expected, warning) and "Please report this message" in warning
        with pytest.raises(UserError, match="'cuda' can't run: its compiler or the driver"):
            picture("cuda")
    assert not (tmp_path / "cubins").exists()
    mended = use(HostDevice())
    picture()
    assert "blend" in mended.launched


@pytest.mark.parametrize(
    "error",
    [
        torch.cuda.OutOfMemoryError("no memory, says the test"),
        RuntimeError("CUDA error: out of memory"),
        UserError("CUDA failed at loading blend.cu: out of memory (2)."),
    ],
)
def test_memory_that_is_short_is_no_verdict(use, tmp_path, error):
    use(BrokenDevice(FAULTS["project"], error))
    with pytest.raises(type(error)):
        picture()
    assert not (tmp_path / "cubins").exists()


@pytest.mark.parametrize("failing", ["require_torch", "reference"])
def test_an_error_of_earlier_work_or_of_torch_is_no_verdict(use, tmp_path, monkeypatch, failing):
    def fails(*_):
        raise RuntimeError("CUDA error: device-side assert triggered")

    use(HostDevice())
    with monkeypatch.context() as patch, pytest.raises(RuntimeError, match="device-side"):
        patch.setattr(proof, failing, fails)
        picture()
    assert not (tmp_path / "cubins").exists()
    device = use(HostDevice())
    picture()
    assert "blend" in device.launched


def test_a_gradient_of_a_culled_gaussian_is_a_difference(use):
    use(HostDevice())
    found = proof.drawn_on(CPU)
    found[DEFAULT]["gradient of means"][-1, 0] = 100.0
    errors = proof.relative_errors(found, proof.reference())[DEFAULT]
    assert [name for name, size in errors.items() if size > 0.1] == ["gradient of means"]


def test_deterministic_algorithms_are_switched_on_again(use, monkeypatch):
    """What they refuse would count as a failure of the kernels."""
    seen, draw = [], proof.torch_backend.rasterize

    def noted(*arguments):
        seen.append(torch.are_deterministic_algorithms_enabled())
        return draw(*arguments)

    monkeypatch.setattr(proof.torch_backend, "rasterize", noted)
    use(HostDevice())
    try:
        torch.use_deterministic_algorithms(True, warn_only=True)
        picture()
        assert torch.are_deterministic_algorithms_enabled() and seen == [False] * 2
        assert torch.is_deterministic_algorithms_warn_only_enabled()
    finally:
        torch.use_deterministic_algorithms(False)


def test_the_comparison_differentiates_in_any_mode_and_draws_no_random_numbers(use):
    device, state = use(HostDevice()), torch.get_rng_state()
    with torch.inference_mode():
        picture()
    assert "blend_backward" in device.launched and torch.equal(state, torch.get_rng_state())
