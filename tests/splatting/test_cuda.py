"""The CUDA kernels, emulated on the host by `cuda_shim`, against the float64 specification."""

from types import SimpleNamespace

import pytest
import torch

from tests.helpers.cuda_shim.device import ORDERS, HostDevice, unavailable
from tests.helpers.refusals import refused
from tests.helpers.splatting_contract import KernelContract
from tests.helpers.splatting_scenes import (
    BACKGROUND,
    NAMES,
    Cloud,
    cameras,
    cotangents,
    draw,
    equal,
    random_cloud,
    rasterize,
)
from threestudio_gaussiandreamer.splatting import backends
from threestudio_gaussiandreamer.splatting.cuda import backend as cuda
from threestudio_gaussiandreamer.splatting.cuda import driver as cuda_driver

SLOW = pytest.mark.slow
pytestmark = pytest.mark.skipif(unavailable() is not None, reason=str(unavailable()))


@pytest.fixture(autouse=True)
def device(monkeypatch):
    """Return the backend on CPU tensors, with a device that tests may replace."""
    devices = [HostDevice()]
    on_the_cpu = backends.Backend(cuda, ("cpu",), (torch.float32,))
    monkeypatch.setitem(backends.BACKENDS, "cuda", on_the_cpu)
    monkeypatch.setattr(cuda_driver, "unavailable", lambda: None)
    monkeypatch.setattr(cuda_driver, "device", lambda device: devices[-1])
    monkeypatch.setattr(cuda, "_estimates", {})

    def exchange(**options) -> HostDevice:
        devices.append(HostDevice(**options))
        return devices[-1]

    return exchange


@SLOW
class TestCudaKernels(KernelContract):
    @pytest.fixture
    def backend(self):
        return "cuda"


def scene(device, cloud=None, **options):
    """Render 3 x 2 tiles per view with all features, on a new device."""
    device(**options)
    cloud = random_cloud(300, seed=8, size=0.1) if cloud is None else cloud
    view = cameras(3, 40, 24), 40, 24, BACKGROUND
    return draw("cuda", cloud, *view, camera_gradient=True, absgrad=True)


def same(a, b) -> bool:
    return equal(a, b) and torch.equal(a.out.means2d.absgrad, b.out.means2d.absgrad)


def opaque_cloud() -> Cloud:
    """Return a cloud of which every tile needs the first chunk only."""
    cloud = random_cloud(500, seed=9, size=0.9)
    return cloud._replace(opacities=torch.full_like(cloud.opacities, 0.99))


each_cloud = pytest.mark.parametrize(
    "cloud", [pytest.param(None, id="thin"), pytest.param(opaque_cloud(), id="opaque", marks=SLOW)]
)


@each_cloud
def test_the_order_of_the_threads_changes_no_bit(device, cloud):
    """Detects a missing barrier, and sums in the order of arrival."""
    one, *others = (scene(device, cloud, order=order) for order in ORDERS)
    assert all(same(one, other) for other in others)


@each_cloud
def test_nothing_is_read_before_it_is_written(device, monkeypatch, cloud):
    """Torch fills allocations with NaN, the emulation shared memory."""
    plain = scene(device, cloud)
    monkeypatch.setattr(torch.utils.deterministic, "fill_uninitialized_memory", True)
    torch.use_deterministic_algorithms(True)
    try:
        assert torch.empty(1).isnan()
        corrupted = scene(device, cloud)
    finally:
        torch.use_deterministic_algorithms(False)
    assert same(plain, corrupted)
    assert cloud is None or plain.out.alpha.min() > 1 - 1e-4


@pytest.mark.parametrize("kernel", ["faulty_barrier", "faulty_race"])
def test_the_emulation_detects_faults(kernel):
    out = {order: torch.zeros(64, dtype=torch.int32) for order in ORDERS}
    try:
        for order in ORDERS:
            HostDevice(order).launch(kernel, (1, 1), 64, out[order])
    except AssertionError as fault:
        assert kernel == "faulty_barrier" and "threads that don't meet" in str(fault)
    else:
        assert kernel == "faulty_race" and not torch.equal(out["forward"], out["backward"])


def test_a_picture_that_needs_more_room_is_right_to_the_bit(device, monkeypatch, recorded):
    """Rendered without lists, differentiated with complete ones."""
    lists = recorded(cuda, "_draw")
    monkeypatch.setattr(cuda, "STEP", 64)
    known = scene(device)
    for estimate in cuda._estimates.values():
        estimate.per_gaussian = 0.5  # as if earlier pictures had needed less
    short, host = scene(device, arrived=False), cuda_driver.device(None)
    assert same(known, short)
    assert same(known, scene(device, arrived=False))
    host.arrived = True
    assert same(known, scene(device))
    # the scene has 1904 intersections
    assert [found.capacity >= 1904 for _, found in lists] == [True, False, False, True]


def test_only_the_first_picture_of_a_size_waits_and_capacity_follows_the_count(device):
    cloud, camera = random_cloud(50).to(torch.float32), cameras(2, 40, 24, dtype=torch.float32)
    host = device()
    host.arrived = False
    with torch.no_grad():
        for waits in (1, 1, 1):
            rasterize(*cloud, *camera, 40, 24, backend="cuda")
            assert host.waits == waits
        host.arrived = True
        rasterize(*cloud, *camera, 40, 24, backend="cuda")
        assert host.waits == 4, "the three numbers that have arrived are read"
        rasterize(*cloud, *camera, 40, 25, backend="cuda")
    assert host.waits == 5
    estimate, host = cuda.CapacityEstimate(views=2), HostDevice()

    def room(*totals, gaussians=1000):
        return estimate.capacity(host.read_async(torch.tensor(totals).cumsum(0)), gaussians)

    assert 6_000_000 < room(3_000_000, 1_000_000) < 6_010_000
    assert 3_000_000 * 0.99 < room(10, 10, gaussians=500) < 3_000_000
    for _ in range(1000):
        small = room(10, 10)
    assert small <= 2 * cuda.STEP


@pytest.mark.parametrize("most", [1500, 900])
def test_short_memory_means_fewer_views_at_a_time(device, monkeypatch, most):
    """Three views have 1904 intersections; the second call doesn't try all at once."""
    monkeypatch.setattr(cuda, "STEP", 64)
    known, tries = scene(device), []
    for _ in range(2):
        short = scene(device, most_intersections=most)
        assert same(known, short)
        launched = cuda_driver.device(None).launched
        assert 1 < launched.count("blend") <= 3 and 1 < launched.count("blend_backward_absolute")
        tries.append(launched.count("list_tiles"))
    assert tries[0] == tries[1] + 1


def test_memory_that_is_short_in_the_backward_pass_only(device, monkeypatch):
    monkeypatch.setattr(cuda, "STEP", 64)
    known, host = scene(device), device()
    cloud = random_cloud(300, seed=8, size=0.1).to(torch.float32).leaves()
    camera = [x.float() for x in cameras(3, 40, 24)]
    out = rasterize(*cloud, *camera, 40, 24, background=BACKGROUND, backend="cuda")
    host.most_intersections = 1500
    torch.autograd.backward([out.image, out.alpha, out.depth], cotangents(out))
    assert host.launched.count("blend_backward") > 1
    for name, leaf in zip(NAMES, cloud, strict=True):
        assert torch.equal(leaf.grad, known.grads[name])


def test_without_memory_for_one_view_there_is_a_picture_but_no_gradient(device, caplog):
    cloud = random_cloud(300, seed=8, size=0.1).to(torch.float32).leaves()
    camera = cameras(1, 40, 24, dtype=torch.float32)
    known = rasterize(*cloud, *camera, 40, 24, backend="cuda")
    device(most_intersections=10)
    cuda._report_short_memory.cache_clear()
    short = rasterize(*cloud, *camera, 40, 24, backend="cuda")
    assert "memory is too short" in caplog.text
    assert torch.equal(known.image, short.image)
    assert torch.equal(known.contribution, short.contribution)
    refused(r"overlap \d+ tiles .* GiB .* fewer or smaller Gaussians", short.image.sum().backward)
    for shape in ((5000, 500_000), (70_000, 1)):
        refused("fewer views", cuda.rasterize, SimpleNamespace(shape=shape), None)
