"""The CPU kernel against the float64 specification, in every build that this machine can run."""

import functools
import os
import pathlib
import shutil
import subprocess
import sys
import tempfile
import weakref
from concurrent.futures import ThreadPoolExecutor
from unittest import mock

import pytest
import torch

from tests.helpers import splatting_scenes as scenes
from tests.helpers.refusals import refused
from tests.helpers.splatting_contract import KernelContract
from threestudio_gaussiandreamer.core import options as memory
from threestudio_gaussiandreamer.core.devices import torch_threads
from threestudio_gaussiandreamer.core.errors import UserError
from threestudio_gaussiandreamer.splatting import validation
from threestudio_gaussiandreamer.splatting.cpu import backend as cpu

EMULATED, SLOW = "v4 emulated", pytest.mark.slow
HEADER = pathlib.Path(__file__).parents[1] / "helpers" / "avx512_emulated.h"
EMULATION = "-std=c++17 -O1 -march=x86-64-v3 -fPIC -shared -pthread -fvisibility=hidden".split()
EMULATION += "-ffp-contract=off -fno-math-errno -fno-trapping-math -Wno-psabi".split()
pytestmark = pytest.mark.skipif(cpu.unavailable() is not None, reason=str(cpu.unavailable()))


@functools.cache
def emulated() -> tempfile.TemporaryDirectory:
    """Compile the build of 16 lanes with emulated AVX-512 intrinsics, once per process."""
    target, source = tempfile.TemporaryDirectory(), cpu.FOLDER / "rasterize.cpp"
    includes = ["-include", str(HEADER), f"-I{cpu.FOLDER.parent / 'shared'}"]
    library = str(pathlib.Path(target.name, "libsplat_v4.so"))
    subprocess.run(["g++", *EMULATION, *includes, str(source), "-o", library], check=True)
    return target


@pytest.fixture
def force(monkeypatch):
    def force(name):
        if name == EMULATED:
            name, folder = "v4", pathlib.Path(emulated().name)
            monkeypatch.setattr(cpu, "usable_builds", lambda: [name])
            monkeypatch.setattr(cpu, "_path", lambda build: folder / f"libsplat_{build}.so")
        monkeypatch.setenv("GAUSSIANDREAMER_ISA", name)
        cpu.library.cache_clear()

    yield force
    cpu.library.cache_clear()


BUILDS = cpu.usable_builds()
if "v3" in BUILDS and "v4" not in BUILDS and shutil.which("g++"):
    BUILDS.append(EMULATED)


@pytest.fixture(params=BUILDS)
def isa(request, force):
    force(request.param)
    return request.param


@pytest.fixture(params=[*BUILDS[:1], *(pytest.param(name, marks=SLOW) for name in BUILDS[1:])])
def backend(request, force):
    """Select a build; the fast tests have the whole contract of the one that a run uses."""
    force(request.param)
    return "cpu"


class TestCpuKernel(KernelContract):
    pass


def test_buffers_that_were_used_before_change_nothing(isa):
    """Faint Gaussians take all three chunks of a tile, opaque ones in their place the first."""
    faint = scenes.random_cloud(1200, seed=6, size=0.6)
    faint.opacities.mul_(0.02)
    opaque = faint._replace(opacities=torch.full_like(faint.opacities, 0.9))
    view = scenes.cameras(1, 34, 18), 34, 18
    for cloud in (faint, opaque, faint):
        scenes.compare("cpu", cloud, *view, preset="accurate", absgrad=True)


def test_both_passes_stop_at_the_same_gaussian(isa):
    """Also when the transmittance equals ``stop`` up to its last bit."""
    generator = torch.Generator().manual_seed(0)
    row, view = scenes.one_gaussian(scale=1e4), (scenes.front_camera(1, 1, 1.0), 1, 1)
    for _ in range(30):
        opacities = 0.05 + 0.45 * torch.rand(12, generator=generator)
        stack = scenes.Cloud(*(x.repeat(12, *[1] * (x.dim() - 1)) for x in row))
        stack = stack._replace(opacities=opacities.double())
        stop = (1 - opacities).cumprod(0)[6].item()
        for scale in (1 - 1.2e-7, 1, 1 + 1.2e-7):
            drawn = scenes.draw("cpu", stack, *view, stop=stop * scale)
            assert torch.equal(drawn.out.contribution[0] > 0, drawn.grads["colors"].any(1))


def test_the_number_of_threads_changes_no_bit(isa):
    """Also with more Gaussians than one task takes, and more threads than views."""
    cloud, camera = scenes.random_cloud(9000, seed=10, size=0.03), scenes.cameras(3, 150, 90)
    options, results = {"camera_gradient": True, "absgrad": True}, []
    for count in (1, 2, 4, 4):
        with torch_threads(count):
            results.append(scenes.draw("cpu", cloud, camera, 150, 90, scenes.BACKGROUND, **options))
    assert all(scenes.equal(results[0], other) for other in results[1:])


def test_backward_frees_its_memory_and_threads_may_draw_at_once(monkeypatch):
    """With the saved tensors, not with the graph's last tensor."""
    states, create = weakref.WeakSet(), cpu._State
    monkeypatch.setattr(cpu, "_State", lambda *x: states.add(state := create(*x)) or state)
    cloud = scenes.random_cloud(30).to(torch.float32)
    camera = scenes.cameras(1, 12, 12, dtype=torch.float32)
    out = scenes.rasterize(*cloud.leaves(), *camera, 12, 12, backend="cpu")
    assert len(states) == 1
    out.image.sum().backward()
    assert len(states) == 0 and out.image.grad_fn is not None
    clouds = [scenes.random_cloud(200, seed=n) for n in range(4)]
    view = {"camera": scenes.cameras(2, 60, 40), "width": 60, "height": 40}
    render = functools.partial(scenes.draw, "cpu", **view)
    alone = [render(cloud) for cloud in clouds]
    # one stand-in for all threads, whose own would be left behind
    with mock.patch.object(validation, "check_ranges"), ThreadPoolExecutor(4) as pool:
        for _ in range(5):
            together = zip(alone, pool.map(render, clouds), strict=True)
            assert all(scenes.equal(a, b) for a, b in together)


SCENE = """
import os, resource, signal, sys, torch
from tests.helpers.splatting_scenes import cameras, random_cloud
from threestudio_gaussiandreamer.splatting import rasterize

def draw():
    camera = cameras(1, 96, 96, dtype=torch.float32)
    return rasterize(*cloud, *camera, 96, 96, backend="cpu").image

cloud = random_cloud(3000).to(torch.float32)
torch.set_num_threads(1)
alone = draw()
torch.set_num_threads(4)
"""
FORKED = """
for _ in range(100):
    draw()
    child = os.fork()
    if child == 0:
        signal.alarm(10)
        os._exit(not all(torch.equal(draw(), alone) for _ in range(5)))
    if os.waitpid(child, 0)[1]:
        sys.exit("a child hung, or drew something else")
"""
LIMITED = """
pages = int(open("/proc/self/statm").read().split()[0])
resource.setrlimit(resource.RLIMIT_AS, (pages * resource.getpagesize() + 6 * 2**20,) * 2)
if not torch.equal(draw(), alone):
    sys.exit("another picture")
"""


@pytest.mark.slow
@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="forks, and reads /proc")
@pytest.mark.parametrize("text", [FORKED, LIMITED], ids=["forked", "limited"])
def test_threads_that_are_not_there(text):
    """Of the parent, whose locks are never released; those whose stacks find no address space."""
    environment = os.environ | {"PYTHONPATH": str(pathlib.Path(__file__).parents[2])}
    command = [sys.executable, "-c", SCENE + text]
    done = subprocess.run(command, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_more_memory_than_there_is_or_the_container_has_is_a_named_error(monkeypatch, tmp_path):
    """At least 2.6e9 pairs of Gaussian and tile: beyond 32 bits and the memory of any machine."""
    cloud, camera = scenes.random_cloud(40_000), scenes.cameras(1, 8192, 8192, dtype=torch.float32)
    cloud = cloud._replace(scales=torch.full((40_000, 3), 1e3)).to(torch.float32)
    with pytest.raises(UserError, match="GiB"), torch.no_grad():
        scenes.rasterize(*cloud, *camera, 8192, 8192, backend="cpu")
    cloud = scenes.random_cloud(50_000).to(torch.float32)
    scene = *cloud, *scenes.cameras(4, 256, 256, dtype=torch.float32), 256, 256
    build = os.environ.get("GAUSSIANDREAMER_ISA") or cpu.usable_builds()[0]
    monkeypatch.setattr(memory, "CGROUP_LIMIT", tmp_path / "memory.max")
    (tmp_path / "memory.max").write_text(str(1 << 20))
    try:
        cpu._load(build)
        refused("GiB", scenes.rasterize, *scene, backend="cpu")
    finally:
        monkeypatch.undo()
        cpu._load(build)
    scenes.rasterize(*scene, backend="cpu")


@pytest.mark.parametrize("threads", [1, 4])
def test_the_last_tile_of_the_tallest_image(threads):
    """Its number and the one behind it still have 16 bits."""
    cloud, sums = scenes.one_gaussian(mean=(0.0, 0.0, 2.0), scale=0.01).to(torch.float32), []
    for height in (64, validation.LARGEST_SIDE):
        viewmats, Ks = (x.to(torch.float32) for x in scenes.front_camera(1, height, 100.0))
        Ks[:, 1, 2] = height - 3.0
        with torch_threads(threads):
            out = scenes.rasterize(*cloud, viewmats, Ks, 1, height, backend="cpu")
        sums.append(out.alpha[0, -64:].flatten())
        assert out.alpha.sum() == sums[-1].sum() > 0.1
    torch.testing.assert_close(*sums, rtol=0, atol=1e-6)


def test_builds_of_another_version_or_name_and_none_are_refused(monkeypatch, force, tmp_path):
    with monkeypatch.context() as patch, pytest.raises(OSError, match="earlier version"):
        patch.setattr(cpu, "INTERFACE", cpu.INTERFACE + 1)
        cpu._load(cpu.usable_builds()[0])
    force("v5")
    refused("GAUSSIANDREAMER_ISA=v5, but .* only have .*base", cpu.library)
    monkeypatch.setattr(cpu, "FOLDER", tmp_path)
    cpu.library.cache_clear()
    try:
        assert "compiler" in cpu.unavailable()
    finally:
        cpu.library.cache_clear()


@pytest.mark.slow
@pytest.mark.parametrize("threads", ["posix", "win32"])
def test_the_kernel_compiles_for_windows(tmp_path, threads):
    """With MinGW-w64. The win32 threads of GCC 12 have no std::mutex: one line says so."""
    compiler = shutil.which(f"x86_64-w64-mingw32-g++-{threads}")
    if compiler is None:
        pytest.skip(f"needs the cross compiler x86_64-w64-mingw32-g++-{threads}")
    source = pathlib.Path(cpu.__file__).with_name("rasterize.cpp")
    options = ["-std=c++17", "-O0", "-shared", f"-I{source.parents[1] / 'shared'}"]
    command = [compiler, *options, str(source), "-o", str(tmp_path / "a.dll")]
    done = subprocess.run(command, capture_output=True, text=True)
    errors = [line for line in done.stderr.splitlines() if "error:" in line]
    if threads == "posix" or done.returncode == 0:
        assert not errors and (tmp_path / "a.dll").exists()
    else:
        assert "MinGW-w64 with POSIX threads" in errors[0]
