"""All fuzz targets: valid files, how to damage them, and what must hold."""

import contextlib
import io
import os
import signal
import struct
import tempfile
import traceback
import tracemalloc
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import cache, partial
from pathlib import Path
from typing import Any, NamedTuple, Optional
from unittest import mock

import numpy as np
import torch
import zstandard
from PIL import Image

from tests.formats.test_splat import ksplat_file
from tests.fuzz import mutations, oracles
from tests.fuzz.mutations import BINARY, TEXT, Mutator, Packing
from tests.helpers.object_clouds import ball
from tests.helpers.ply_files import gaussians, ply_bytes
from tests.helpers.splatting_scenes import NAMES
from threestudio_gaussiandreamer import register_parts
from threestudio_gaussiandreamer.core.checkpoint_file import load_checkpoint, save_file
from threestudio_gaussiandreamer.core.errors import UserError
from threestudio_gaussiandreamer.core.logs import logger
from threestudio_gaussiandreamer.formats import ply
from threestudio_gaussiandreamer.formats.compressed_ply import read_compressed_ply
from threestudio_gaussiandreamer.formats.gaussian_files import StoredCloud, read_cloud, write_cloud
from threestudio_gaussiandreamer.formats.sog import read_sog
from threestudio_gaussiandreamer.formats.splat import RECORD, read_ksplat, read_splat
from threestudio_gaussiandreamer.formats.spz import read_spz, spz_bytes
from threestudio_gaussiandreamer.formats.usda import read_usda
from threestudio_gaussiandreamer.gaussians.gaussians import Gaussians, usable
from threestudio_gaussiandreamer.gaussians.point_cloud import PointCloud
from threestudio_gaussiandreamer.launch import config, experiment
from threestudio_gaussiandreamer.launch.config_check import check_config
from threestudio_gaussiandreamer.launch.run import Run, lightning_errors
from threestudio_gaussiandreamer.meshes.load import load_mesh
from threestudio_gaussiandreamer.meshes.raycast import MeshCaster
from threestudio_gaussiandreamer.priors.gaussians import GaussiansPrior
from threestudio_gaussiandreamer.priors.mesh import MeshPrior
from threestudio_gaussiandreamer.priors.motion import read_motions
from threestudio_gaussiandreamer.priors.point_cloud import PointCloudPrior
from threestudio_gaussiandreamer.splatting import rasterize
from threestudio_gaussiandreamer.training.geometry import GaussianCloud

ROOT = Path(__file__).parents[2]
register_parts()


class Target(NamedTuple):
    """One reader, or another entry point that takes untrusted input."""

    suffix: str
    seeds: Callable[[], list[bytes]]
    exercise: Callable[[Path], None]
    """Read a file and render it; raise UserError if it was refused, AssertionError if misread."""
    mutators: list[Mutator] = BINARY
    packing: Optional[Packing] = None
    traced: bool = True
    """Whether memory is traced, which is slow."""


EYE = torch.eye(4)[None].clone()
EYE[:, 2, 3] = 3.0
FOCAL = torch.tensor([[[12.0, 0, 6], [0, 12, 6], [0, 0, 1]]])


def require_picture(geometry: GaussianCloud) -> None:
    """Require finite pixels and gradients; gradients may overflow for extreme colours."""
    colors = geometry.colors(torch.tensor([[0.0, 0, -3]]))
    shapes = geometry.means, geometry.quats, geometry.scales(), geometry.opacities()
    out = rasterize(*shapes, colors, EYE, FOCAL, 12, 12)
    assert all(x.isfinite().all() for x in (out.image, out.alpha, out.depth)), "a pixel"
    out.image.clamp(-10, 10).sum().backward()
    bright = torch.nan_to_num(geometry.sh0.detach()).abs().max() > 1e10
    assert bright or geometry.means.grad.isfinite().all(), "a gradient isn't finite"


def cloud_of(arrays: Gaussians) -> GaussianCloud:
    geometry = GaussianCloud({"sh_degree": min(int(arrays.sh.shape[1] ** 0.5) - 1, 3)})
    geometry.set_arrays(**arrays._asdict())
    return geometry


def require_points(cloud: PointCloud) -> None:
    """Require what every prior guarantees."""
    points, colors, faces = cloud.points, cloud.colors, cloud.faces
    assert np.shape(points) == np.shape(colors) == (len(points), 3) and len(points) > 0, "shapes"
    assert np.isfinite(points).all() and np.isfinite(colors).all(), "a number isn't finite"
    assert (colors >= 0).all() and (colors <= 1).all(), "colours outside of [0, 1]"
    if faces is not None and len(faces):
        require_vertices(faces, points)


def require_vertices(faces: np.ndarray, points: np.ndarray) -> None:
    assert faces.min() >= 0 and faces.max() < len(points), "a face names a point that isn't there"


def same(ours: np.ndarray, theirs: np.ndarray, what: str) -> None:
    """Require equal float32 bits; NaN equals NaN."""
    with np.errstate(over="ignore", invalid="ignore"):
        ours, theirs = np.asarray(ours, np.float32), np.asarray(theirs).astype(np.float32)
    equal = ours.shape == theirs.shape and np.array_equal(ours, theirs, equal_nan=True)
    assert equal, f"{what} aren't what the file says"


def strictly(read: Callable[[bytes], Any], path: Path) -> Any:
    """Return what the strict reader makes of a file that the package has read."""
    try:
        return read(path.read_bytes())
    except oracles.Illegal as error:
        raise AssertionError(f"the file was read though it is illegal: {error}") from error


RGB = ("red", "green", "blue")


def some_gaussians(count: int, degree: int) -> Gaussians:
    arrays = gaussians(count, degree)
    return arrays._replace(log_scales=arrays.log_scales - 2)


FACES = "comment made for fuzzing\nelement face 2\nproperty list uchar int vertex_indices\n"
FACES += "property float area"
FACE = np.dtype([("n", "u1"), ("v", "<i4", 3), ("area", "<f4")])
TEXT_FACES = FACES, b"3 0 1 2 0.5\n4 0 1 2 3 0.25\n"
BINARY_FACES = FACES, np.array([(3, [0, 1, 2], 0.5)] * 2, FACE).tobytes()


def gaussian_plys() -> list[bytes]:
    seeds = []
    for encoding, degree in (("ascii", 0), ("binary_little_endian", 1), ("binary_big_endian", 0)):
        arrays = some_gaussians(12, degree)
        names = ply.gaussian_properties(arrays.sh.shape[1])
        table = zip(names, ply.gaussian_columns(arrays).T, strict=True)
        columns = {name: (kind, column) for (name, kind), column in table}
        seeds.append(ply_bytes(columns, encoding, before=BINARY_FACES if degree else ("", b"")))
    return seeds


def point_plys() -> list[bytes]:
    rng = np.random.default_rng(1)
    places = {name: ("float", rng.normal(size=20)) for name in "xyz"}
    kinds = "uchar", "ushort"
    bytes_, shorts = ({n: (kind, rng.integers(0, 255, 20)) for n in RGB} for kind in kinds)
    floats = {name: ("double", rng.random(20)) for name in RGB}
    normals = {name: ("float", np.full(20, 0.577)) for name in ("nx", "ny", "nz")}
    return [
        ply_bytes(places | bytes_, "ascii"),
        ply_bytes(places | normals | bytes_, "binary_little_endian", before=BINARY_FACES),
        ply_bytes(places | shorts, "binary_big_endian"),
        ply_bytes(places | floats, "ascii", before=TEXT_FACES),
    ]


def read_ply(read: Callable, path: Path) -> tuple[Any, oracles.PlyVertices]:
    """Return what the package and the strict reader read."""
    listener = mock.Mock(level=0)
    with mock.patch.object(logger, "handlers", [listener]):
        found = read(path)
    truth = strictly(oracles.ply_vertices, path)
    assert not truth.leftover or listener.handle.called, "data after the end without a message"
    return found, truth


def exercise_gaussians_ply(path: Path) -> None:
    arrays, truth = read_ply(ply.read_gaussians, path)
    columns = truth.columns

    def stacked(names: Sequence[str]) -> np.ndarray:
        return np.stack([columns[name] for name in names], 1)

    rest = [f"f_rest_{i}" for i in range(sum(name.startswith("f_rest_") for name in columns))]
    sh = stacked(ply.SH_CONSTANT)[:, None]
    if rest:
        higher = stacked(rest).reshape(truth.count, 3, -1).transpose(0, 2, 1)
        sh = np.concatenate([sh, higher], 1)
    places = (stacked(names) for names in (ply.MEANS, ply.QUATS, ply.LOG_SCALES))
    for found, true, name in zip(arrays, (*places, columns["opacity"], sh), NAMES, strict=True):
        same(found, true, name)
    prior = GaussiansPrior({"path": str(path)})
    require_points(prior("a fox"))
    require_picture(cloud_of(prior.gaussians("a fox")))


def exercise_points_ply(path: Path) -> None:
    cloud, truth = read_ply(ply.read_points, path)
    same(cloud.points, np.stack([truth.columns[name] for name in "xyz"], 1), "points")
    named = set(RGB) <= set(truth.columns) and "float_red" not in truth.columns
    if named and truth.types["red"] == "B":
        colors = np.stack([truth.columns[name] for name in RGB], 1) / 255
        close = np.allclose(cloud.colors, colors, atol=1e-6, equal_nan=True)
        assert close, "colours aren't what the file says"
    exercise_points(path)


MOTION = np.random.default_rng(0).normal(size=(2, 22, 3, 5)).astype(np.float32)
ROWS = np.random.default_rng(1).random((15, 6))


def saved(save: Callable, *arguments: Any, **named: Any) -> bytes:
    buffer = io.BytesIO()
    save(buffer, *arguments, **named)
    return buffer.getvalue()


def motion_archives() -> list[bytes]:
    text, lengths = np.array(["a walk", "ein Sprung ü"]), np.array([5, 3])
    named = {"motion": MOTION, "text": text, "lengths": lengths}
    archives = [saved(save, **named) for save in (np.savez, np.savez_compressed)]
    return [*archives, saved(np.save, MOTION)]


def exercise_motions(path: Path) -> None:
    motions = read_motions(str(path))
    samples, frames, joints, three = motions.positions.shape
    assert joints in (22, 24) and three == 3 and len(motions.lengths) == samples, "shapes"
    for positions, length in zip(motions.positions, motions.lengths, strict=True):
        assert 0 < length <= frames and np.isfinite(positions[:length]).all(), "frames"
    if path.read_bytes()[:6] == b"\x93NUMPY":
        whole = strictly(oracles.npy_array, path).size == motions.positions.size
        assert whole, "numbers are missing"


def point_archives() -> list[bytes]:
    colors, normals = (255 * ROWS[:, 3:]).astype(np.uint8), ROWS[:, :3].astype(np.float32)
    named = {"points": ROWS[:, :3], "colors": colors, "normals": normals}
    return [saved(save, **named) for save in (np.savez, np.savez_compressed)]


def exercise_points(path: Path) -> None:
    require_points(PointCloudPrior({"path": str(path)})("a fox"))


def exercise_npy_points(path: Path) -> None:
    cloud = PointCloudPrior({"path": str(path)})("a fox")
    require_points(cloud)
    rows = strictly(oracles.npy_array, path)
    with np.errstate(over="ignore", invalid="ignore"):
        numbers = rows[:, :3].astype(np.float32) if rows.dtype.kind in "fiu" else np.zeros((0, 3))
    good = np.isfinite(numbers).all(axis=1)
    assert len(cloud.points) <= len(good) <= 1.06 * len(cloud.points) + 1, "rows are missing"


def texts() -> list[bytes]:
    points = b"\n".join(b" ".join(b"%.6f" % value for value in row[:3]) for row in ROWS)
    colored = b"\n".join(b",".join(b"%.6f" % value for value in row) for row in ROWS)
    integers = [(*row[:3], *(255 * row[3:]).astype(int)) for row in ROWS]
    scan = b"15\n" + b"\n".join(b"%.4f %.4f %.4f 12 %d %d %d" % row for row in integers)
    return [points, b"x,y,z,r,g,b\n" + colored, scan]


def files(suffix: str, shapes=((12, 0), (9, 1)), **options: Any) -> list[bytes]:
    """Return files of a format, of (count, degree) each."""
    made = []
    with tempfile.TemporaryDirectory() as folder:
        for count, degree in shapes:
            cloud = StoredCloud(some_gaussians(count, degree), antialiased=degree == 1)
            write_cloud(f"{folder}/a{suffix}", cloud, **options)
            made.append(Path(folder, f"a{suffix}").read_bytes())
    return made


def spz_files() -> list[bytes]:
    clouds = (((12, 0),), ((9, 1), ["up: y"]), ((3, 3),))
    return [spz_bytes(some_gaussians(*shape), *comments) for shape, *comments in clouds]


def exercise_spz(path: Path) -> None:
    arrays, _ = read_spz(path)
    count = int.from_bytes(strictly(oracles.gunzipped, path)[8:12], "little")
    assert len(arrays.means) == count, f"{len(arrays.means)} Gaussians, but the file says {count}"
    assert usable(arrays).all(), "values aren't finite"
    if count:
        require_picture(cloud_of(arrays))


def splats() -> list[bytes]:
    rows = np.zeros(11, RECORD)
    rng = np.random.default_rng(0)
    rows["mean"], rows["scale"] = rng.normal(size=(11, 3)), rng.random((11, 3))
    rows["rgba"], rows["quat"] = (rng.integers(0, 256, (11, 4)) for _ in range(2))
    return [rows.tobytes(), rows[:1].tobytes()]


def ksplats() -> list[bytes]:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "a.ksplat")
        clouds = [(level, [ball(50, 1 + level % 2)]) for level in range(3)]
        return [ksplat_file(path, level, cloud).read_bytes() for level, cloud in clouds]


def drawn(path: Path) -> Gaussians:
    """Read the drawable Gaussians of a file and render them."""
    gaussians = read_cloud(str(path)).gaussians
    if len(gaussians.means):
        require_picture(cloud_of(gaussians))
    return gaussians


def exercise_counted(count_of: Callable[[bytes], int], path: Path) -> None:
    """Require that no more Gaussians are read than the strict reader finds in the file."""
    found, announced = len(drawn(path).means), strictly(count_of, path)
    assert found <= announced, f"{found} Gaussians, but the file says {announced}"


def spz_count(data: bytes) -> int:
    """Return the count in the plain header of SPZ 4; versions before are gzip."""
    plain = data if data[:4] == b"NGSP" else oracles.gunzipped(data)
    return int.from_bytes(plain[8:12], "little")


def glb_count(data: bytes) -> int:
    """Return the sum of the counts of the positions, for each node that has a mesh."""
    document = oracles.glb_document(data)
    uses = sum("mesh" in node for node in document.get("nodes", []))
    primitives = [item for mesh in document.get("meshes", []) for item in mesh["primitives"]]
    places = [item.get("attributes", {}).get("POSITION") for item in primitives]
    counts = (document["accessors"][place]["count"] for place in places if place is not None)
    return uses * sum(counts)


def exercise_splat(path: Path) -> None:
    read, _ = read_splat(path)
    rows = np.frombuffer(path.read_bytes(), RECORD)
    same(read.means, rows["mean"], "means")
    with np.errstate(divide="ignore", invalid="ignore"):
        same(read.log_scales, np.log(rows["scale"]), "scales")
    drawn(path)


def exercise_means(read: Callable, means_of: Callable[[bytes], np.ndarray], path: Path) -> None:
    """Require that every position is the one that the strict reader finds."""
    found = read(path)
    found = (found if isinstance(found, Gaussians) else found[0]).means
    with np.errstate(over="ignore", invalid="ignore"):
        expected = strictly(means_of, path).astype(np.float32)
        assert found.shape == expected.shape, f"{len(found)} Gaussians, not {len(expected)}"
        close = np.isclose(found, expected, rtol=1e-4, atol=1e-4, equal_nan=True)
    assert close.all(), "positions aren't those of the file"
    drawn(path)


def _unsog(data: bytes) -> list[tuple[str, bytes]]:
    """Split an archive into its members, images as width, height and pixels."""
    pieces = []
    for name, content in mutations.ZIP.unpack(data):
        if name.endswith(".webp"):
            with Image.open(io.BytesIO(content)) as image:
                content = struct.pack("<HH", *image.size) + image.convert("RGBA").tobytes()
        pieces.append((name, content))
    return pieces


def _sog(pieces: list[tuple[str, bytes]]) -> bytes:
    packed = []
    for name, content in pieces:
        if name.endswith(".webp"):
            sizes = struct.unpack("<HH", content[:4].ljust(4, b"\0"))
            width, height = ((n - 1) % 64 + 1 for n in sizes)
            pixels = content[4 : 4 + 4 * width * height].ljust(4 * width * height, b"\0")
            image, file = Image.frombytes("RGBA", (width, height), pixels), io.BytesIO()
            image.save(file, "WEBP", lossless=True, exact=True)
            content = file.getvalue()
        packed.append((name, content))
    return mutations.ZIP.pack(packed)


def _unspz(data: bytes) -> list[tuple[str, bytes]]:
    """Split SPZ 4 into its header, with the record of the axes, and unpacked blocks."""
    table = int.from_bytes(data[16:20], "little")
    pieces, at = [("header", data[:table])], table + 16 * data[15]
    for index in range(data[15]):
        size, plain = struct.unpack_from("<QQ", data, table + 16 * index)
        frame = zstandard.ZstdDecompressor().decompressobj().decompress(data[at : at + size])
        pieces.append((str(plain), frame))
        at += size
    return pieces


def _spz(pieces: list[tuple[str, bytes]]) -> bytes:
    header, *blocks = (content for _, content in pieces)
    frames = [zstandard.compress(block) for block in blocks]
    table = [struct.pack("<QQ", len(a), len(b)) for a, b in zip(frames, blocks, strict=True)]
    return b"".join([header, *table, *frames])


SOG, SPZ_4 = Packing(_unsog, _sog), Packing(_unspz, _spz)


def meshes(kind: str) -> list[bytes]:
    """Return a box with a texture, with colours, and as two objects of a scene."""
    import trimesh

    rng = np.random.default_rng(0)
    image = Image.fromarray(rng.integers(0, 255, (4, 4, 3), dtype=np.uint8))
    textured, by_vertex, by_face = (trimesh.creation.box((1, 0.7, 0.5)) for _ in range(3))
    visual, uv = trimesh.visual, textured.vertices[:, :2] + 0.5
    material = visual.material.PBRMaterial(baseColorTexture=image) if kind == "glb" else None
    textured.visual = visual.TextureVisuals(uv=uv, image=image, material=material)
    by_vertex.visual.vertex_colors = rng.integers(0, 255, (8, 4))
    by_face.visual.face_colors = rng.integers(0, 255, (12, 4))
    scene = trimesh.Scene([by_vertex])
    scene.add_geometry(textured, transform=trimesh.transformations.translation_matrix([0, 2, 0]))
    sources = {"glb": [textured, by_vertex, scene], "obj": [textured, by_vertex]}
    sources["ply"] = [by_vertex, by_face]
    seeds = [source.export(file_type=kind) for source in sources.get(kind, [by_vertex])]
    return [seed.encode() if isinstance(seed, str) else seed for seed in seeds]


def exercise_mesh(path: Path) -> None:
    """A prior from the vertices, one from the surface, and a picture by ray casting."""
    mesh = load_mesh(path)
    inside = np.isfinite(mesh.vertices).all() and np.abs(mesh.vertices).max() < 1 + 1e-6
    assert inside, "vertices outside of the box"
    require_vertices(mesh.faces, mesh.vertices)
    for options in ({}, {"num_points": 50}):
        require_points(MeshPrior({"path": str(path), **options})("a fox"))
    c2w = np.array([[0.0, 0, 1, 3], [1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 0, 1]])
    image = MeshCaster(mesh).render_views([(c2w, 0.8)], 8, 8, supersample=1)
    assert np.isfinite(image).all() and image.min() >= 0 and image.max() < 1 + 1e-5, "a pixel"


def exercise_ply_mesh(path: Path) -> None:
    exercise_mesh(path)
    strictly(oracles.ply_vertices, path)


def checkpoints() -> list[bytes]:
    """One as a run writes it, with its checksum, and one of plain torch."""
    torch.manual_seed(0)
    geometry = cloud_of(some_gaussians(10, 0))
    optimizer = torch.optim.Adam(geometry.parameter_groups(), lr=1e-3)
    require_picture(geometry)
    optimizer.step()
    content = {
        "epoch": 0, "global_step": 7, "pytorch-lightning_version": "2.6.6", "callbacks": {},
        "lr_schedulers": [],
        "state_dict": {f"geometry.{key}": value for key, value in geometry.state_dict().items()},
        "optimizer_states": [optimizer.state_dict()],
        "loops": {"fit_loop": {"state_dict": {}, "epoch_progress": {"total": {"ready": 1}}}},
    }  # fmt: skip
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "last.ckpt")
        save_file(path, content)
        plain = io.BytesIO()
        torch.save(content, plain)
        return [path.read_bytes(), plain.getvalue()]


def exercise_checkpoint(path: Path) -> None:
    """Nothing is read whose checksums don't hold, or that the file is too small for."""
    checkpoint = load_checkpoint(path)
    strictly(oracles.checked_archive, path)
    tensors, size = list(_tensors(checkpoint)), path.stat().st_size
    storages = {t.untyped_storage().data_ptr(): t.untyped_storage().nbytes() for t in tensors}
    assert sum(storages.values()) <= size, f"tensors larger than a file of {size} bytes"
    assert all(t.numel() * t.element_size() <= size for t in tensors), "a tensor is too large"
    state, own = checkpoint["state_dict"].items(), "geometry."
    geometry = GaussianCloud({})
    with lightning_errors(str(path)):
        geometry.load_state_dict({k.removeprefix(own): v for k, v in state if k.startswith(own)})
    if len(geometry):
        require_picture(geometry)


def _tensors(value: Any) -> Iterator[torch.Tensor]:
    if isinstance(value, torch.Tensor):
        yield value
    elif isinstance(value, (dict, list, tuple)):
        for item in value.values() if isinstance(value, dict) else value:
            yield from _tensors(item)


def configurations() -> list[bytes]:
    """Those that say everything, or all but the prompt."""
    paths = (ROOT / "configs" / f"{name}.yaml" for name in ("demo", "gaussiandreamer"))
    return [path.read_bytes().replace(b"???", b'"a fox: red"') for path in paths]


def exercise_configuration(path: Path) -> None:
    """What is accepted, written and read again is the same run."""
    cfg = config.load_config(path)
    check_config(cfg)
    parsed = path.with_name("parsed.yaml")
    config.dump_config(parsed, cfg)
    again = config.load_config(parsed)
    ours, theirs = (config.OmegaConf.to_container(c, resolve=False) for c in (cfg, again))
    for key in ("resume", "new_folder"):  # of this run alone
        ours[key] = theirs[key] = None
    assert repr(ours) == repr(theirs), "parsed.yaml isn't the same run"


COMMANDS = [
    b"--config\ndemo.yaml\n--train\n--gpu\ncpu\ntrainer.max_steps=1200\n"
    b"system.prompt_processor.prompt=a fox: red, 1984\nseed=3\ntag=t",
    b"--config\ndemo.yaml\n--config\ndemo-draft.yaml\n--export\n"
    b"resume=outputs/demo/x/ckpts/last.ckpt\nsystem.geometry.prior_type=random-prior\n"
    b"data.elevation_range=[-10,60]\nsystem.geometry.densify={enabled: true, start: 9, stop: 99}",
    b"--config\ngaussiandreamer\n--test\n--verbose\nsystem.prompt_processor.prompt=1984\n"
    b"name=a b\nuse_timestamp=false\nsystem.guidance.max_step_percent=[0,0.98,0.5,500]\n"
    b"system.geometry.lr_means=1e-4\nsystem.exporter.formats=[ply,points]\n"
    b"checkpoint.save_last=true\ndata.batch_size=${seed}\nseed=2",
]


def exercise_command(path: Path) -> None:
    """Exit code 2 with one message, or 0 where nothing but the work itself would follow."""
    arguments = path.read_bytes().decode("utf-8", errors="surrogateescape").split("\n")
    arguments = [argument for argument in arguments if not argument.startswith("--typecheck")]
    out, err = io.StringIO(), io.StringIO()
    of_logger = {name: getattr(logger, name) for name in ("propagate", "level")}
    of_logger["handlers"] = [*logger.handlers]
    with mock.patch.dict(os.environ), mock.patch.multiple(logger, **of_logger):
        with mock.patch.object(Run, "run", lambda self: 0), warnings.catch_warnings():
            with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
                code = experiment.main(arguments)
    assert code in (0, 2), f"exit code {code}"
    if code == 2:
        assert "error: " in err.getvalue(), "exit code 2 without a message"
        raise UserError(err.getvalue())


def npy_files() -> list[bytes]:
    return [saved(np.save, ROWS), saved(np.save, ROWS[:, :3].astype(np.float32))]


PLY, ZIP, GLB = mutations.PLY, mutations.ZIP, mutations.GLB
count_spz, count_glb = (partial(exercise_counted, count) for count in (spz_count, glb_count))
read_archive = partial(exercise_means, read_sog, oracles.sog_means)
read_layer = partial(exercise_means, read_usda, oracles.usda_means)
read_sections = partial(exercise_means, read_ksplat, oracles.ksplat_means)
read_compressed = partial(exercise_means, read_compressed_ply, oracles.compressed_means)
compressed_files = partial(files, ".compressed.ply", [(12, 0), (260, 1)])
TARGETS: dict[str, Target] = {
    "ply-gaussians": Target(".ply", gaussian_plys, exercise_gaussians_ply, packing=PLY),
    "ply-points": Target(".ply", point_plys, exercise_points_ply, packing=PLY),
    "ply-mesh": Target(".ply", partial(meshes, "ply"), exercise_ply_mesh, packing=PLY),
    "glb": Target(".glb", partial(meshes, "glb"), exercise_mesh, packing=GLB),
    "obj": Target(".obj", partial(meshes, "obj"), exercise_mesh, TEXT),
    "stl": Target(".stl", partial(meshes, "stl"), exercise_mesh),
    "off": Target(".off", partial(meshes, "off"), exercise_mesh, TEXT),
    "checkpoint": Target(".ckpt", checkpoints, exercise_checkpoint, packing=ZIP),
    "configuration": Target(".yaml", configurations, exercise_configuration, TEXT, traced=False),
    "command-line": Target(".txt", COMMANDS.copy, exercise_command, TEXT, traced=False),
    "motion": Target(".npz", motion_archives, exercise_motions, packing=ZIP),
    "points-npz": Target(".npz", point_archives, exercise_points, packing=ZIP),
    "points-npy": Target(".npy", npy_files, exercise_npy_points),
    "points-text": Target(".xyz", texts, exercise_points, TEXT),
    "spz": Target(".spz", spz_files, exercise_spz, packing=mutations.GZIP),
    "spz-4": Target(".spz", partial(files, ".spz", spz_version=4), count_spz, packing=SPZ_4),
    "sog": Target(".sog", partial(files, ".sog"), read_archive, packing=SOG),
    "ksplat": Target(".ksplat", ksplats, read_sections),
    "glb-gaussians": Target(".glb", partial(files, ".glb"), count_glb, packing=GLB),
    "compressed-ply": Target(".compressed.ply", compressed_files, read_compressed, packing=PLY),
    "splat": Target(".splat", splats, exercise_splat),
    "usda": Target(".usda", partial(files, ".usda"), read_layer, TEXT),
}


@cache
def seeds(name: str) -> list[bytes]:
    """Return the valid files; one is read, which imports, before memory is measured."""
    valid = TARGETS[name].seeds()
    outcome_of(TARGETS[name]._replace(traced=False), valid[0])
    return valid


def mutant(name: str, seed: int, index: int) -> bytes:
    """Return the damaged file with this index."""
    target, rng = TARGETS[name], np.random.default_rng([seed, index, *name.encode()])
    return mutations.mutant(seeds(name), rng, target.mutators, target.packing)


SECONDS = 10.0
"""CPU time that one file may take; the slowest valid one takes a tenth of a second."""
FIXED_BYTES, PER_BYTE = 24 << 20, 64
"""Memory that Python may allocate for a file: fixed, and per byte of the file."""


class Outcome(NamedTuple):
    kind: str
    """ "refused" with a UserError, "read" correctly, or "failed"."""
    detail: str = ""


class Hang(BaseException):
    """The time limit; derives from BaseException so that the code under test can't catch it."""


def outcomes(name: str, indices: Iterable[int], seed: int) -> Iterator[tuple[int, Outcome]]:
    """Yield the outcome of each damaged file of these indices."""
    for index in indices:
        yield index, outcome_of(TARGETS[name], mutant(name, seed, index))


def outcome_of(target: Target, data: bytes) -> Outcome:
    """Return the outcome of one file, in a temporary folder."""
    before, peak = os.getcwd(), 0
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "input" + target.suffix)
        path.write_bytes(data)
        os.chdir(folder)
        if target.traced:
            tracemalloc.start()
        try:
            outcome = _run(target, path)
        finally:
            os.chdir(before)
            if target.traced:
                peak = tracemalloc.get_traced_memory()[1]
                tracemalloc.stop()
    if outcome.kind != "failed" and peak > FIXED_BYTES + PER_BYTE * len(data):
        return Outcome("failed", f"memory: {peak >> 20} MiB for a file of {len(data)} bytes")
    return outcome


def _run(target: Target, path: Path) -> Outcome:
    try:
        with _time_limit(SECONDS):
            target.exercise(path)
        return Outcome("read")
    except UserError as error:
        return Outcome("refused", str(error)[:200])
    except AssertionError as error:
        return Outcome("failed", f"misread: {error}")
    except Hang:
        return Outcome("failed", f"hang: more than {SECONDS:g} s of CPU time")
    except Exception as error:
        frame = traceback.extract_tb(error.__traceback__)[-1]
        place = f"{Path(frame.filename).name}:{frame.lineno}"
        return Outcome("failed", f"crash: {type(error).__name__}: {str(error)[:120]} ({place})")


@contextlib.contextmanager
def _time_limit(seconds: float) -> Iterator[None]:
    earlier = signal.signal(signal.SIGPROF, mock.Mock(side_effect=Hang))
    signal.setitimer(signal.ITIMER_PROF, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
        signal.signal(signal.SIGPROF, earlier)
