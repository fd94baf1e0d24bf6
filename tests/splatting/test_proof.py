"""The first use of the CUDA kernels on a device: compared with plain torch, in emulation."""

import pytest
import torch

from tests.helpers.cuda_shim.device import HostDevice, unavailable
from tests.helpers.splatting_scenes import cameras, random_cloud
from threestudio_gaussiandreamer.core.errors import UserError
from threestudio_gaussiandreamer.splatting import backends, rasterize
from threestudio_gaussiandreamer.splatting.cuda import driver, proof, stages
from threestudio_gaussiandreamer.training.renderer import check_backend

pytestmark = pytest.mark.skipif(unavailable() is not None, reason=str(unavailable()))
CPU = torch.device("cpu")


class BrokenDevice(HostDevice):
    """Gives one kernel other constants than the rest, or raises ``error`` instead."""

    def __init__(self, kernel: str, eps2d: float = 0.4, error: Exception | None = None) -> None:
        super().__init__()
        self.kernel, self.eps2d, self.error = kernel, eps2d, error

    def launch(self, name: str, grid: tuple[int, int], threads: int, *arguments) -> None:
        if name == self.kernel and self.error is not None:
            raise self.error
        for argument in arguments if name == self.kernel else ():
            if isinstance(argument, stages._Settings):
                argument.eps2d, argument.alpha_max = self.eps2d, 0.9
        super().launch(name, grid, threads, *arguments)


@pytest.fixture
def use(monkeypatch, tmp_path):
    """Let "auto" find a GPU, on the CPU; returns a function that begins a new start with another
    device.
    """
    monkeypatch.setenv("GAUSSIANDREAMER_CACHE", str(tmp_path / "cubins"))
    cuda = backends.Backend(
        "cuda.backend", devices=("cpu",), dtypes=(torch.float32,), proof="cuda.proof"
    )
    found = {"cuda": cuda, "torch": backends.BACKENDS["torch"]}
    monkeypatch.setattr(backends, "BACKENDS", found)
    monkeypatch.setattr(driver, "unavailable", lambda: None)

    def begin(device: HostDevice) -> HostDevice:
        monkeypatch.setattr(driver, "device", lambda _: device)
        proof._failure.cache_clear()
        backends._warn_once.cache_clear()
        return device

    yield begin
    proof._failure.cache_clear()


def picture(backend: str = "auto") -> torch.Tensor:
    cloud = random_cloud(20, seed=1).to(torch.float32)
    camera = cameras(1, 12, 12, dtype=torch.float32)
    return rasterize(*cloud, *camera, 12, 12, backend=backend).image


def test_right_kernels_are_used_and_compared_once(use):
    device = use(HostDevice())
    image = picture()
    assert device.launched.count("blend") == 2 and device.launched.count("blend_backward") == 1
    assert torch.equal(image, picture("cuda"))
    assert device.launched.count("blend") == 3
    again = use(HostDevice())  # the verdict is read from the cache
    assert torch.equal(image, picture()) and again.launched.count("blend_backward") == 0


def test_right_kernels_are_far_from_the_tolerance(use):
    use(HostDevice())
    errors = proof.errors_on(CPU, proof.reference())
    assert max(errors.values()) < proof.TOLERANCE / 10
    assert len(errors) == 12


@pytest.mark.parametrize("kernel", ["project", "blend", "blend_backward", "project_backward"])
def test_a_broken_kernel_means_plain_torch_and_one_warning(use, caplog, kernel):
    use(BrokenDevice(kernel))
    assert torch.equal(picture(), picture("torch"))
    picture()
    (warning,) = [record.getMessage() for record in caplog.records]
    assert "its kernels differ from plain torch: " in warning and "gradient of " in warning
    assert "[the stand-in, torch " in warning and "Please report this line" in warning
    with pytest.raises(UserError, match="'cuda' can't run: .*differ from plain torch"):
        picture("cuda")


def test_broken_kernels_are_refused_before_a_run_begins(use):
    use(BrokenDevice("blend"))
    with pytest.raises(UserError, match="a.backend: cuda can't be used here: .*differ from plain"):
        check_backend("a.backend", "cuda")
    check_backend("a.backend", "auto")
    use(HostDevice())
    check_backend("a.backend", "torch")


def test_the_verdict_about_broken_kernels_is_cached_until_its_file_is_removed(use, tmp_path):
    use(BrokenDevice("blend"))
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


def test_a_nan_is_a_difference(use):
    use(BrokenDevice("project_backward", eps2d=float("nan")))
    with pytest.raises(UserError, match="gradient of means by nan"):
        picture("cuda")


@pytest.mark.parametrize(
    "error", [UserError("CUDA failed at launching the kernel blend"), RuntimeError("CUDA error")]
)
def test_a_failed_launch_means_plain_torch(use, caplog, error):
    use(BrokenDevice("blend", error=error))
    assert torch.equal(picture(), picture("torch"))
    assert f"its kernels fail on a small scene: {error}" in caplog.text


@pytest.mark.parametrize(
    "error",
    [
        torch.cuda.OutOfMemoryError("no memory, says the test"),
        RuntimeError("CUDA error: out of memory"),
        UserError("CUDA failed at loading blend.cu: out of memory (2)."),
    ],
)
def test_memory_that_is_short_is_no_verdict(use, tmp_path, error):
    use(BrokenDevice("project", error=error))
    with pytest.raises(type(error)):
        picture()
    assert not (tmp_path / "cubins").exists()


@pytest.mark.parametrize("failing", ["_require_torch", "reference"])
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


@pytest.mark.parametrize("warns", [False, True])
def test_deterministic_algorithms_are_switched_on_again(use, monkeypatch, warns):
    """What they refuse would count as a failure of the kernels."""
    seen, draw = [], proof.torch_backend.rasterize

    def noted(*arguments):
        seen.append(torch.are_deterministic_algorithms_enabled())
        return draw(*arguments)

    monkeypatch.setattr(proof.torch_backend, "rasterize", noted)
    use(HostDevice())
    try:
        torch.use_deterministic_algorithms(True, warn_only=warns)
        picture()
        assert torch.are_deterministic_algorithms_enabled() and seen == [False]
        assert torch.is_deterministic_algorithms_warn_only_enabled() == warns
    finally:
        torch.use_deterministic_algorithms(False)


@pytest.mark.parametrize("mode", [torch.no_grad, torch.inference_mode])
def test_the_comparison_differentiates_in_any_mode_and_draws_no_random_numbers(use, mode):
    device, state = use(HostDevice()), torch.get_rng_state()
    with mode():
        picture()
    assert "blend_backward" in device.launched and torch.equal(state, torch.get_rng_state())
