"""The CUDA kernels compile without spilling, are cached, and are loaded by the driver."""

import contextlib
import ctypes
import logging
import re
from concurrent.futures import ThreadPoolExecutor
from types import SimpleNamespace

import pytest
import torch

from tests.helpers.cuda_shim.device import library, needs_nvrtc, unavailable
from tests.helpers.refusals import refused
from tests.helpers.splatting_scenes import cameras, equal, random_cloud, run
from threestudio_gaussiandreamer.core.errors import UserError
from threestudio_gaussiandreamer.splatting import available_backends, backends
from threestudio_gaussiandreamer.splatting.cuda import backend as cuda
from threestudio_gaussiandreamer.splatting.cuda import driver as cuda_driver
from threestudio_gaussiandreamer.splatting.cuda import nvrtc

ARCHITECTURES = (75, 80, 86, 89, 90, 100, 120)
THREADS = {"blend": 256, "blend_backward": 256}  # per block; 128 in the other units
REGISTERS = 65536  # of a multiprocessor


@pytest.fixture
def cache(monkeypatch, tmp_path):
    monkeypatch.setenv("GAUSSIANDREAMER_CACHE", str(tmp_path / "cubins"))
    return tmp_path / "cubins"


@pytest.fixture
def compiled(monkeypatch):
    units, original = [], nvrtc.compile_unit
    monkeypatch.setattr(nvrtc, "compile_unit", lambda *a: units.append(a[0]) or original(*a))
    return units


def units():
    return sorted(path.stem for path in nvrtc.KERNELS.glob("*.cu"))


def properties(log: str) -> dict[str, list[int]]:
    """Return registers, shared bytes, spilled bytes and stack of each kernel."""
    entry = r"Compiling entry function '(\w+)'(.*?)(?=Compiling entry function|\Z)"
    numbers = [r"Used (\d+) registers"]
    numbers += [rf"(\d+) bytes {name}" for name in ("smem", "spill", "stack")]
    return {
        name: [sum(map(int, re.findall(pattern, text))) for pattern in numbers]
        for name, text in re.findall(entry, log, re.DOTALL)
    }


@pytest.mark.slow
@needs_nvrtc
@pytest.mark.parametrize("architecture", ARCHITECTURES)
def test_every_kernel_compiles_without_spills(architecture):
    """Three blocks of each fit on a multiprocessor by their registers."""
    seen = set()
    for unit in units():
        code, log = nvrtc.compile_unit(unit, f"sm_{architecture}")
        assert code[:4] == b"\x7fELF" and "warning" not in log, log
        for name, (registers, shared, spilled, stack) in properties(log).items():
            assert cuda_driver.UNITS[name] == unit
            assert spilled == stack == 0 and shared <= 48 * 1024, name
            assert 0 < registers * THREADS.get(unit, 128) <= REGISTERS // 3, name
            seen.add(name)
    assert seen == set(cuda_driver.UNITS)


@needs_nvrtc
def test_what_the_compiler_rejects_is_named(monkeypatch):
    monkeypatch.setattr(nvrtc, "source", lambda unit: "void f() { undeclared = 1; }")
    rejected = r"NVRTC of CUDA .* can't compile blend.cu for sm_90: (.|\n)*\"undeclared\" is undef"
    refused(rejected, nvrtc.compile_unit, "blend", "sm_90")


def test_what_the_compiler_torch_and_the_device_need_of_each_other(monkeypatch, tmp_path):
    monkeypatch.setenv("GAUSSIANDREAMER_NVRTC", "/no/such/libnvrtc.so")
    nvrtc._library.cache_clear()
    try:
        with pytest.raises(OSError, match="NVRTC.*nvidia-cuda-nvrtc.*/no/such/libnvrtc.so"):
            nvrtc.version()
    finally:
        nvrtc._library.cache_clear()
    builtins = "cuda_nvrtc/lib/libnvrtc-builtins.so.12.8"
    for place in ("cu13/lib/libnvrtc.so.13", "cuda_nvrtc/lib/libnvrtc.so.12", builtins):
        (tmp_path / "nvidia" / place).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / "nvidia" / place).touch()
    monkeypatch.delenv("GAUSSIANDREAMER_NVRTC", raising=False)
    monkeypatch.setenv("CUDA_HOME", "x" * 300)  # can't be read, as a folder without permission
    monkeypatch.setattr(nvrtc.sysconfig, "get_paths", lambda: {"purelib": str(tmp_path)})
    for release, first in (("12.8", "libnvrtc.so.12"), ("13.0", "libnvrtc.so.13")):
        monkeypatch.setattr(torch.version, "cuda", release)
        ours = [path for path in nvrtc._candidates() if str(tmp_path) in path]
        assert ours[0].endswith(first) and len(ours) == 2
    monkeypatch.setattr(nvrtc, "version", lambda: (13, 0))
    monkeypatch.setattr(nvrtc, "architectures", lambda: [52, 75, 80, 86, 90, 120])
    targets = {(7, 5): "sm_75", (9, 0): "sm_90", (13, 0): "compute_120", (8, 7): "compute_86"}
    assert {capability: nvrtc.target_for(capability) for capability in targets} == targets
    for known in ([52, 70, 75, 90], [75, 90], [80, 90]):
        monkeypatch.setattr(nvrtc, "architectures", lambda known=known: known)
        needed = f"needs {max(75, known[0]) / 10} or later: use backend='torch'"
        refused(rf"capability 7\.0;.*CUDA 13\.0, {needed}", nvrtc.target_for, (7, 0))
    monkeypatch.setattr(torch.version, "cuda", None)
    cuda_driver.unavailable.cache_clear()
    try:
        assert "without CUDA" in available_backends()["cuda"]
    finally:
        cuda_driver.unavailable.cache_clear()


@needs_nvrtc
def test_compiled_code_is_kept_on_the_disk(cache, compiled, tmp_path, monkeypatch, caplog):
    first = nvrtc.machine_code("bin", "sm_80")
    assert nvrtc.machine_code("bin", "sm_80") == first and compiled == ["bin"]
    (path,) = cache.iterdir()
    whole = path.read_bytes()
    for count, damaged in enumerate((whole[:-1], whole[:50] + b"!" + whole[51:], b""), 2):
        path.write_bytes(damaged)
        again = nvrtc.machine_code("bin", "sm_80")  # with CUDA 12.4, of other bytes in its names
        assert again[:4] == b"\x7fELF" and compiled == ["bin"] * count
        assert nvrtc.machine_code("bin", "sm_80") == again and len(compiled) == count
    assert nvrtc.machine_code("bin", "sm_90") != first and len(list(cache.iterdir())) == 2
    (tmp_path / "file").touch()
    monkeypatch.setenv("GAUSSIANDREAMER_CACHE", str(tmp_path / "file" / "folder"))
    with caplog.at_level(logging.WARNING):
        assert nvrtc.machine_code("bin", "sm_80")[:4] == b"\x7fELF"
    assert "can't be kept" in caplog.text and "file" in caplog.text
    names = {nvrtc._key("bin", "sm_80"), nvrtc._key("blend", "sm_80"), nvrtc._key("bin", "sm_86")}
    changes = {"source": lambda unit: "other", "headers": lambda: {"splat_math.h": "other"}}
    changes |= {"version": lambda: (99, 0), "OPTIONS": ("-O0",)}
    for name, other in changes.items():
        with monkeypatch.context() as patch:
            patch.setattr(nvrtc, name, other)
            names.add(nvrtc._key("bin", "sm_80"))
    assert len(names) == 7


@pytest.fixture
def driver(monkeypatch, cache):
    """Provide a driver that runs kernels on the host, and a torch that sees one GPU."""
    if unavailable() is not None:
        pytest.skip(unavailable())
    fake = ctypes.CDLL(library()._name)
    fake.fake_stream.restype = ctypes.c_void_p
    ctypes.c_int.in_dll(fake, "fake_loads").value = 0
    ctypes.c_int.in_dll(fake, "fake_release").value = 99000
    event = SimpleNamespace(record=lambda: None, query=lambda: True, synchronize=lambda: None)
    gpu = {
        "device": lambda index: contextlib.nullcontext(),
        "current_stream": lambda: SimpleNamespace(cuda_stream=fake.fake_stream()),
        "current_device": lambda: 0,
        "init": lambda: None,
        "is_available": lambda: True,
        "get_device_capability": lambda index=0: (9, 0),
        "Event": lambda: event,
    }
    for name, value in gpu.items():
        monkeypatch.setattr(torch.cuda, name, value)
    empty = torch.empty
    monkeypatch.setattr(torch, "empty", lambda *a, pin_memory=False, **more: empty(*a, **more))
    monkeypatch.setattr(torch.version, "cuda", "13.0")
    monkeypatch.setattr(cuda_driver, "LIBRARY", library()._name)
    caches = (cuda_driver._driver, cuda_driver._gpu, cuda_driver.unavailable)
    for function in caches:
        function.cache_clear()
    yield fake
    for function in caches:
        function.cache_clear()


@needs_nvrtc
def test_a_picture_by_way_of_the_driver(driver, monkeypatch, compiled):
    """Compiled, loaded, and launched, in autograd's thread too."""
    on_the_cpu = backends.Backend(cuda, ("cpu",), (torch.float32,))
    monkeypatch.setitem(backends.BACKENDS, "cuda", on_the_cpu)
    monkeypatch.setattr(cuda, "_estimates", {})
    assert available_backends()["cuda"] is None
    cloud, camera = random_cloud(60).to(torch.float32), cameras(2, 20, 20, dtype=torch.float32)
    first = run(cloud, *camera, 20, 20, backend="cuda")
    with ThreadPoolExecutor(1) as pool:
        again = pool.submit(run, cloud, *camera, 20, 20, backend="cuda").result()
    plain = run(cloud, *camera, 20, 20, backend="torch")
    assert equal(first, again) and (first.out.image - plain.out.image).abs().max() < 1e-6
    loads = ctypes.c_int.in_dll(driver, "fake_loads").value
    assert sorted(compiled) == units() and loads == len(units())


@needs_nvrtc
def test_code_that_the_driver_refuses_and_why_no_gpu_can_be_used(driver, monkeypatch):
    monkeypatch.setattr(nvrtc, "machine_code", lambda unit, target: b"nonsense")
    loading = r"loading blend.cu for sm_90 \(NVRTC of CUDA .*, driver of CUDA 99.0\)"
    with pytest.raises(UserError, match=rf"{loading}: .*invalid \(200\)"):
        cuda_driver.device(torch.device("cuda")).launch("blend", (1, 1), 256)

    def reason(owner, name, value):
        with monkeypatch.context() as patch:
            patch.setattr(owner, name, value)
            for function in (cuda_driver._driver, cuda_driver.unavailable):
                function.cache_clear()
            return cuda_driver.unavailable()

    ctypes.c_int.in_dll(driver, "fake_release").value = 12040
    advice = "update the driver, or install a torch built for CUDA 12"
    words = f"driver knows CUDA up to 12.4, .* CUDA 13.1: {advice}"
    assert re.search(words, reason(nvrtc, "version", lambda: (13, 1)))
    missing = "libcuda-that-is-not-there.so"
    assert missing in reason(cuda_driver, "LIBRARY", missing)
    said = reason(nvrtc, "_library", lambda: ctypes.CDLL(library()._name))
    assert "undefined symbol: nvrtcGetNumSupportedArchs" in said
