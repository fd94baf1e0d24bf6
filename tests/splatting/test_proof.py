"""The first use of the CUDA kernels on a device: compared with plain torch, in emulation."""

import ctypes
import functools
import logging
import re
from collections.abc import Callable
from typing import NamedTuple

import pytest
import torch

from tests.helpers.cuda_shim.device import HostDevice, library, unavailable
from tests.helpers.refusals import refused
from tests.helpers.splatting_scenes import cameras, random_cloud, rasterize
from threestudio_gaussiandreamer.core.errors import UserError
from threestudio_gaussiandreamer.splatting import backends
from threestudio_gaussiandreamer.splatting.cuda import driver, nvrtc, proof
from threestudio_gaussiandreamer.splatting.scene import Settings
from threestudio_gaussiandreamer.training.renderer import check_backend

pytestmark = pytest.mark.skipif(unavailable() is not None, reason=str(unavailable()))
CPU = torch.device("cpu")
DEFAULT = next(iter(proof.OPTIONS))


def nothing(*_) -> None:
    """Change nothing."""


def settings_of(arguments) -> Settings:
    (settings,) = (x for x in arguments if isinstance(x, Settings))
    return settings


def other_constants(*arguments, eps2d: float = 0.4, halved: bool = False) -> None:
    """Change what the kernel alone is given; with ``halved`` only if it downsamples."""
    settings = settings_of(arguments)
    if not halved or settings.downsample == 2:
        settings.eps2d, settings.alpha_max = eps2d, 0.5


other_constants_if_halved = functools.partial(other_constants, halved=True)


def double_the_last_two_columns(rows) -> None:
    rows[:, -2:].mul_(2)


def no_antialiasing(*arguments) -> None:
    settings_of(arguments).antialias = 0


def alpha_for_depth_if_halved(scene, settings, lists, images, contribution) -> None:
    if settings.downsample == 2:
        images[1], images[2] = images[2], images[1]


class Fault(NamedTuple):
    """One kernel that is given other arguments, or whose last tensor is changed after it ran."""

    kernel: str
    before: Callable[..., None] = nothing
    after: Callable[[torch.Tensor], object] = nothing


FAULTS = {
    **{name: Fault(name, other_constants) for name in ("project", "blend", "project_backward")},
    **{name: Fault(name, other_constants) for name in driver.UNITS if "blend_backward" in name},
    "count_tiles": Fault("count_tiles", after=lambda counts: counts.clamp_(max=1)),
    "list_tiles": Fault("list_tiles", after=lambda owners: owners.zero_()),
    "find_tiles": Fault("find_tiles", after=lambda begins: begins[1].copy_(begins[0])),
    "sum_rows": Fault("sum_rows", after=lambda sums: sums.mul_(1.01)),
    "sum_cameras": Fault("sum_cameras", after=lambda viewmats: viewmats.mul_(1.01)),
    "project, antialias": Fault("project", no_antialiasing),
    "project_backward, antialias": Fault("project_backward", no_antialiasing),
    "blend, downsample": Fault("blend", alpha_for_depth_if_halved),
    "blend_backward, downsample": Fault("blend_backward", other_constants_if_halved),
    "sums of absolute values": Fault("blend_backward_absolute", after=double_the_last_two_columns),
}
"""A fault in every kernel, and in those branches that only some options run."""
QUICK = ("project", "list_tiles", "project_backward", "sums of absolute values")


class BrokenDevice(HostDevice):
    """Has a fault, or raises ``error`` instead."""

    def __init__(self, fault: Fault, error: Exception | None = None) -> None:
        super().__init__()
        self.fault, self.error = fault, error

    def launch(self, name: str, grid: tuple[int, int], threads: int, *arguments) -> None:
        if name != self.fault.kernel:
            super().launch(name, grid, threads, *arguments)
            return
        if self.error is not None:
            raise self.error
        self.fault.before(*arguments)
        super().launch(name, grid, threads, *arguments)
        self.fault.after(arguments[-1])


class NamedDevice(HostDevice):
    """Describes itself as a GPU does."""

    index, target = 0, "sm_90"
    describe = driver.Gpu.describe


@pytest.fixture
def use(monkeypatch, tmp_path):
    """Let "auto" find a GPU, on the CPU; returns a function that begins a start with a device."""
    monkeypatch.setenv("GAUSSIANDREAMER_CACHE", str(tmp_path / "cubins"))
    cuda = backends.Backend(proof.kernels, ("cpu",), (torch.float32,), proof)
    found = {"cuda": cuda, "torch": backends.BACKENDS["torch"]}
    monkeypatch.setattr(backends, "BACKENDS", found)
    monkeypatch.setattr(driver, "unavailable", lambda: None)
    monkeypatch.setattr(driver, "driver_version", lambda: (13, 0))
    monkeypatch.setattr(torch.cuda, "get_device_name", lambda _: "a GPU")

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


def the_warning(caplog) -> str:
    """Return the only warning; a launch in the same process lets compilations be logged too."""
    (warning,) = (r.getMessage() for r in caplog.records if r.levelno >= logging.WARNING)
    return warning


def test_right_kernels_are_compared_once_and_are_far_from_the_tolerance(use):
    """Also in inference mode, and without random numbers."""
    device, state = use(HostDevice()), torch.get_rng_state()
    with torch.inference_mode():
        image = picture()
    assert device.launched.count("blend") == len(proof.OPTIONS) + 1
    assert set(device.launched) == set(driver.UNITS)
    assert torch.equal(state, torch.get_rng_state())
    assert torch.equal(image, picture("cuda"))
    assert device.launched.count("blend") == len(proof.OPTIONS) + 2
    again = use(HostDevice())  # the verdict is read from the cache
    assert torch.equal(image, picture()) and again.launched.count("blend_backward") == 0
    use(HostDevice())
    found = proof.drawn(proof.kernels, CPU, torch.float32)
    expected = proof.drawn(proof.torch_backend, CPU, torch.float64)
    errors = proof.relative_errors(found, expected)
    assert [*errors] == [*proof.OPTIONS]
    assert max(max(sizes.values()) for sizes in errors.values()) < proof.TOLERANCE / 10
    assert [len(sizes) for sizes in errors.values()] == [11, 11, 12]
    found[DEFAULT]["gradient of means"][-1, 0] = 100.0  # of a culled Gaussian
    found[DEFAULT]["image"][0, 0, 0, 0] = torch.nan
    errors = proof.relative_errors(found, expected)[DEFAULT]
    wrong = [name for name, size in errors.items() if not size < 0.1]
    assert wrong == ["image", "gradient of means"]


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
    warning = the_warning(caplog)
    assert "its kernels differ from plain torch: " in warning
    assert "[the stand-in, torch " in warning and "Please report this message" in warning


def test_the_verdict_about_broken_kernels_is_cached_until_its_file_is_removed(use, tmp_path):
    """And they are refused before a run begins; NaN is a difference."""
    nan = functools.partial(other_constants, eps2d=float("nan"))
    use(BrokenDevice(Fault("project_backward", nan)))
    refused("a.backend: .*cuda' can't run: .*differ from plain", check_backend, "a.backend", "cuda")
    check_backend("a.backend", "auto")
    refused("'cuda' can't run: .*gradient of means by nan", picture, "cuda")
    mended = use(HostDevice())
    assert torch.equal(picture(), picture("torch")) and not mended.launched
    (verdict,) = (tmp_path / "cubins").iterdir()
    refused(f"delete {verdict} and start again", picture, "cuda")
    verdict.unlink()
    use(mended)
    picture()
    assert "blend" in mended.launched


OLD, NEW = (
    "NVRM version: NVIDIA UNIX x86_64 Kernel Module  570.86.15  Fri\nGCC version:  13.3.0\n",
    "NVRM version: NVIDIA UNIX Open Kernel Module for aarch64  580.65.06  Release\n",
)


def test_another_driver_is_compared_again(use, monkeypatch, tmp_path):
    """Of the same CUDA release; without its own version the release counts."""
    monkeypatch.setattr(nvrtc, "version", lambda: (13, 0))
    monkeypatch.setattr(driver, "VERSION_FILE", tmp_path / "version")
    compared = []
    monkeypatch.setattr(proof, "compare", lambda _: compared.append(1) or "")
    use(NamedDevice())
    for text, build in ((None, ""), (OLD, "570.86.15 "), (NEW, "580.65.06 "), ("unknown", "")):
        if text is not None:
            (tmp_path / "version").write_text(text)
        proof.failure.cache_clear()
        expected = f"a GPU, sm_90, driver {build}of CUDA 13.0, NVRTC of CUDA 13.0"
        assert driver.device(CPU).describe() == expected
        assert proof.failure(CPU) is None
    assert len(compared) == 3


def test_a_failing_library_means_torch_until_the_next_start(use, caplog, monkeypatch, tmp_path):
    """At a kernel, and before the GPU's name is known."""
    broken = BrokenDevice(FAULTS["blend"], OSError("no libnvrtc.so"))
    lacking = r"AttributeError: .*undefined symbol: nvrtc.* \[unknown GPU, torch "
    for device, message in (
        (broken, r"OSError: no libnvrtc.so \[the stand-in, torch "),
        (NamedDevice(), lacking),
    ):
        use(device)
        with monkeypatch.context() as patch:
            patch.setattr(nvrtc, "_library", lambda: ctypes.CDLL(library()._name))
            assert torch.equal(picture(), picture("torch"))
            expected = f"its compiler or the driver can't be used: {message}.*Please report"
            assert re.search(expected, the_warning(caplog))
            refused("'cuda' can't run: its compiler or the driver", picture, "cuda")
        caplog.clear()
        assert not (tmp_path / "cubins").exists()
    mended = use(HostDevice())
    picture()
    assert "blend" in mended.launched


@pytest.mark.parametrize(
    "error, is_verdict",
    [
        (UserError("CUDA failed at launching the kernel blend"), True),
        (RuntimeError("CUDA error"), True),
        (torch.cuda.OutOfMemoryError("no memory, says the test"), False),
        (RuntimeError("CUDA error: out of memory"), False),
        (UserError("CUDA failed at loading blend.cu: out of memory (2)."), False),
    ],
)
def test_a_failed_launch_counts_but_not_short_memory(use, caplog, tmp_path, error, is_verdict):
    use(BrokenDevice(FAULTS["blend"], error))
    if is_verdict:
        assert torch.equal(picture(), picture("torch"))
        assert f"its kernels fail on a small scene: {error}" in the_warning(caplog)
        return
    with pytest.raises(type(error)):
        picture()
    assert not (tmp_path / "cubins").exists()


@pytest.mark.parametrize("owner, name", [(torch, "ones"), (proof.torch_backend, "rasterize")])
def test_an_error_of_earlier_work_is_no_verdict(use, tmp_path, monkeypatch, owner, name):
    def fails(*_, **__):
        raise RuntimeError("CUDA error: device-side assert triggered")

    use(HostDevice())
    monkeypatch.setattr(owner, name, fails)
    with pytest.raises(RuntimeError, match="device-side"):
        picture()
    assert not (tmp_path / "cubins").exists()


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
