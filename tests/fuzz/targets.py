"""The doors through which somebody else's bytes come in: for each, good files, how to damage them,
and what must hold.

``exercise`` takes a damaged file through the product as far as a picture. It returns when the file
was read, raises UserError when it was refused in one clear message, and :class:`Misread` when what
was read isn't what the file says. Anything else is a crash."""

import contextlib
import io
import logging
import os
import tempfile
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple, Optional

import numpy as np
import torch

from tests.fuzz import checkpoint_content, config_values, gltf_features, mutations, oracles
from tests.fuzz.mutations import BINARY, TEXT, Mutator, Packing
from tests.fuzz.oracles import Illegal
from threestudio_gaussiandreamer import register_parts
from threestudio_gaussiandreamer.core.checkpoint_file import load_checkpoint, save_file
from threestudio_gaussiandreamer.core.errors import UserError
from threestudio_gaussiandreamer.formats import ply, ply_table
from threestudio_gaussiandreamer.formats.spz import read_spz, spz_bytes
from threestudio_gaussiandreamer.gaussians.gaussians import Gaussians, usable
from threestudio_gaussiandreamer.gaussians.point_cloud import PointCloud
from threestudio_gaussiandreamer.launch import config, experiment
from threestudio_gaussiandreamer.launch.config_check import check_config
from threestudio_gaussiandreamer.launch.run import Run, lightning_errors
from threestudio_gaussiandreamer.meshes.load import load_mesh
from threestudio_gaussiandreamer.meshes.raycast import MeshCaster
from threestudio_gaussiandreamer.priors.gaussians import GaussiansPrior
from threestudio_gaussiandreamer.priors.mesh import MeshPrior
from threestudio_gaussiandreamer.priors.motion_files import read_motions
from threestudio_gaussiandreamer.priors.point_cloud import PointCloudPrior
from threestudio_gaussiandreamer.splatting import rasterize
from threestudio_gaussiandreamer.training.geometry import GaussianCloud

ROOT = Path(__file__).parents[2]
register_parts()


class Misread(Exception):
    """A damaged file was taken for something that it doesn't say."""


class Target(NamedTuple):
    """One door."""

    suffix: str
    seeds: Callable[[], list[bytes]]
    exercise: Callable[[Path], None]
    mutators: list[Mutator] = BINARY
    packing: Optional[Packing] = None
    traced: bool = True
    """Whether memory is watched, which makes Python slow; of configurations the values are counted.
    """


def mutant(name: str, seed: int, index: int) -> bytes:
    """The damaged file of that number."""
    target = TARGETS[name]
    rng = np.random.default_rng([seed, index, *name.encode()])
    return mutations.mutant(seeds(name), rng, target.mutators, target.packing)


_KNOWN: dict[str, list[bytes]] = {}


def seeds(name: str) -> list[bytes]:
    return _KNOWN.setdefault(name, TARGETS[name].seeds())


def require(holds: bool, problem: str) -> None:
    if not holds:
        raise Misread(problem)


# ---- pictures ------------------------------------------------------------------------------------

EYE = torch.eye(4)[None].clone()
EYE[:, 2, 3] = 3.0
FOCAL = torch.tensor([[[12.0, 0, 6], [0, 12, 6], [0, 0, 1]]])


def require_picture(geometry: GaussianCloud) -> None:
    """No pixel and no gradient of a cloud is NaN; gradients may overflow where a colour is beyond
    any picture.
    """
    colors = geometry.colors(torch.tensor([[0.0, 0, -3]]))
    out = rasterize(
        geometry.means,
        geometry.quats,
        geometry.scales(),
        geometry.opacities(),
        colors,
        EYE,
        FOCAL,
        12,
        12,
    )
    require(
        bool(
            out.image.isfinite().all() and out.alpha.isfinite().all() and out.depth.isfinite().all()
        ),
        "a pixel isn't finite",
    )
    out.image.clamp(-10, 10).sum().backward()
    require(
        bool(
            torch.nan_to_num(geometry.sh0.detach()).abs().max() > 1e10
            or geometry.means.grad.isfinite().all()
        ),
        "gradient",
    )


def cloud_of(arrays: Gaussians) -> GaussianCloud:
    geometry = GaussianCloud({"sh_degree": min(int(arrays.sh.shape[1] ** 0.5) - 1, 3)})
    geometry.set_arrays(**arrays._asdict())
    return geometry


def require_points(cloud: PointCloud) -> None:
    """What every prior promises."""
    shapes = {np.shape(cloud.points), np.shape(cloud.colors), (len(cloud.points), 3)}
    require(len(shapes) == 1 and len(cloud.points) > 0, f"shapes {shapes}")
    require(
        bool(np.isfinite(cloud.points).all() and np.isfinite(cloud.colors).all()),
        "points or colours aren't finite",
    )
    require(
        bool((cloud.colors >= 0).all() and (cloud.colors <= 1).all()), "colours outside of [0, 1]"
    )
    if cloud.faces is not None and len(cloud.faces):
        require(
            0 <= cloud.faces.min() and cloud.faces.max() < len(cloud.points),
            "a face names a point that isn't there",
        )


def same(ours: np.ndarray, theirs: np.ndarray, what: str) -> None:
    """Equal to the bit as float32, NaN like NaN."""
    with np.errstate(over="ignore", invalid="ignore"):
        ours, theirs = np.asarray(ours, np.float32), np.asarray(theirs).astype(np.float32)
    require(
        ours.shape == theirs.shape and np.array_equal(ours, theirs, equal_nan=True),
        f"{what} aren't what the file says",
    )


def strictly(read: Callable[[bytes], Any], path: Path) -> Any:
    """What a second reader says of a file that the product has read."""
    try:
        return read(path.read_bytes())
    except Illegal as error:
        raise Misread(f"the file was read though it is illegal: {error}") from error


@contextlib.contextmanager
def messages() -> Iterator[list[str]]:
    """What the product logs meanwhile."""
    records: list[str] = []
    handler = logging.Handler()
    handler.emit = lambda record: records.append(record.getMessage())
    logger = logging.getLogger("threestudio_gaussiandreamer")
    logger.addHandler(handler)
    try:
        yield records
    finally:
        logger.removeHandler(handler)


# ---- PLY -----------------------------------------------------------------------------------------


def some_gaussians(count: int, degree: int, seed: int = 0) -> Gaussians:
    rng = np.random.default_rng(seed)
    shapes = [(count, 3), (count, 4), (count, 3), (count,), (count, (degree + 1) ** 2, 3)]
    arrays = Gaussians(*(rng.normal(size=shape).astype(np.float32) for shape in shapes))
    return arrays._replace(log_scales=arrays.log_scales - 2)


def ply_bytes(
    columns: dict[str, tuple[str, np.ndarray]], encoding: str, faces: bool = False
) -> bytes:
    """A PLY of any encoding, with an element of lists before the vertices if asked for."""
    order = ply_table.BYTE_ORDERS[encoding]
    count = len(next(iter(columns.values()))[1])
    lines = ["ply", f"format {encoding} 1.0", "comment made for fuzzing"]
    lines += (
        ["element face 2", "property list uchar int vertex_indices", "property float area"]
        if faces
        else []
    )
    lines += [
        f"element vertex {count}",
        *(f"property {kind} {name}" for name, (kind, _) in columns.items()),
        "end_header",
    ]
    rows = np.empty(
        count,
        [
            (name, (order or "<") + ply_table.NUMBER_TYPES[kind])
            for name, (kind, _) in columns.items()
        ],
    )
    for name, (_, values) in columns.items():
        rows[name] = values
    if encoding == "ascii":
        body = b"3 0 1 2 0.5\n4 0 1 2 3 0.25\n" if faces else b""
        body += b"".join(
            b" ".join(b"%.9g" % value for value in row) + b"\n" for row in rows.tolist()
        )
    else:
        face = np.dtype([("n", "u1"), ("v", order + "i4", 3), ("area", order + "f4")])
        body = (
            np.array([(3, [0, 1, 2], 0.5)] * 2, face).tobytes() if faces else b""
        ) + rows.tobytes()
    return ("\n".join(lines) + "\n").encode() + body


def gaussian_plys() -> list[bytes]:
    seeds = []
    for encoding, degree, faces in (
        ("ascii", 0, False),
        ("binary_little_endian", 1, True),
        ("binary_big_endian", 0, False),
    ):
        arrays = some_gaussians(12, degree)
        rest = arrays.sh[:, 1:].transpose(0, 2, 1).reshape(12, -1)
        values = [
            arrays.means,
            arrays.sh[:, 0],
            rest,
            arrays.logit_opacities[:, None],
            arrays.log_scales,
            arrays.quats,
        ]
        names = [
            *ply.MEANS,
            *ply.SH_CONSTANT,
            *(f"f_rest_{i}" for i in range(rest.shape[1])),
            "opacity",
            *ply.LOG_SCALES,
            *ply.QUATS,
        ]
        columns = dict(
            zip(
                names,
                (("float", column) for column in np.concatenate(values, axis=1).T),
                strict=True,
            )
        )
        seeds.append(ply_bytes(columns, encoding, faces))
    return seeds


def point_plys() -> list[bytes]:
    rng = np.random.default_rng(1)
    places = {name: ("float", rng.normal(size=20)) for name in "xyz"}
    bytes_, shorts = (
        {name: (kind, rng.integers(0, 255, 20)) for name in ("red", "green", "blue")}
        for kind in ("uchar", "ushort")
    )
    floats = {name: ("double", rng.random(20)) for name in ("red", "green", "blue")}
    normals = {name: ("float", np.full(20, 0.577)) for name in ("nx", "ny", "nz")}
    seeds = [
        ply_bytes(places | bytes_, "ascii"),
        ply_bytes(places | normals | bytes_, "binary_little_endian", faces=True),
    ]
    return [
        *seeds,
        ply_bytes(places | shorts, "binary_big_endian"),
        ply_bytes(places | floats, "ascii", faces=True),
    ]


def exercise_gaussians_ply(path: Path) -> None:
    with messages() as said:
        arrays = ply.read_gaussians(path, allow_non_finite=True)
    truth = strictly(oracles.ply_vertices, path)
    require(not truth.leftover or bool(said), "more follows than the header announces, in silence")
    columns = truth.columns
    rest = [
        columns[f"f_rest_{i}"] for i in range(sum(name.startswith("f_rest_") for name in columns))
    ]
    sh = np.stack([columns[name] for name in ply.SH_CONSTANT], 1)[:, None]
    if rest:
        sh = np.concatenate(
            [sh, np.stack(rest, 1).reshape(truth.count, 3, -1).transpose(0, 2, 1)], 1
        )
    for values, names in (
        (arrays.means, ply.MEANS),
        (arrays.log_scales, ply.LOG_SCALES),
        (arrays.quats, ply.QUATS),
    ):
        same(values, np.stack([columns[name] for name in names], 1), names[0])
    same(arrays.logit_opacities, columns["opacity"], "opacities")
    same(arrays.sh, sh, "harmonics")
    prior = GaussiansPrior({"path": str(path)})
    require_points(prior("a fox"))
    require_picture(cloud_of(prior.gaussians("a fox")))


def exercise_points_ply(path: Path) -> None:
    with messages() as said:
        cloud = ply.read_points(path, allow_non_finite=True)
    truth = strictly(oracles.ply_vertices, path)
    require(not truth.leftover or bool(said), "more follows than the header announces, in silence")
    same(cloud.points, np.stack([truth.columns[name] for name in "xyz"], 1), "points")
    if (
        truth.types.get("red") == "B"
        and {"green", "blue"} <= set(truth.columns)
        and "float_red" not in truth.columns
    ):
        colors = np.stack([truth.columns[name] for name in ("red", "green", "blue")], 1)
        require(
            bool(np.allclose(cloud.colors, colors / 255, atol=1e-6, equal_nan=True)),
            "colours aren't what the file says",
        )
    require_points(PointCloudPrior({"path": str(path)})("a fox"))


# ---- meshes --------------------------------------------------------------------------------------


def exercise_mesh(path: Path) -> None:
    """A prior from the vertices, one from the surface, and a picture by ray casting."""
    mesh = load_mesh(path)
    require(
        bool(np.isfinite(mesh.vertices).all() and np.abs(mesh.vertices).max() < 1 + 1e-6),
        "vertices outside of the box",
    )
    require(
        mesh.faces.min() >= 0 and mesh.faces.max() < len(mesh.vertices),
        "a face names a vertex that isn't there",
    )
    require_points(MeshPrior({"path": str(path)})("a fox"))
    require_points(MeshPrior({"path": str(path), "num_points": 50})("a fox"))
    c2w = np.array([[0.0, 0, 1, 3], [1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 0, 1]])
    image = MeshCaster(mesh).render(c2w, 0.8, 8, 8, supersample=1)
    require(
        bool(np.isfinite(image).all() and image.min() >= 0 and image.max() < 1 + 1e-5),
        "a pixel isn't in [0, 1]",
    )


def exercise_obj(path: Path) -> None:
    exercise_mesh(path)
    require_same_surface(load_mesh(path), strictly(oracles.obj_triangles, path))


def exercise_ply_mesh(path: Path) -> None:
    exercise_mesh(path)
    strictly(oracles.ply_vertices, path)


def exercise_glb(path: Path) -> None:
    exercise_mesh(path)
    corners = strictly(oracles.glb_triangles, path)
    if corners is not None:
        require_same_surface(load_mesh(path), corners)


def exercise_gltf_features(path: Path) -> None:
    problem = gltf_features.exercise(path, exercise_mesh)
    require(problem is None, str(problem))


def require_same_surface(mesh: Any, corners: np.ndarray) -> None:
    """The triangles that a file says, in the product's pose: y up and z in front become z up and x
    in front, the box is [-1, 1].
    """
    corners = corners[np.isfinite(corners).all(axis=(1, 2))]
    require(
        len(corners) == len(mesh.faces),
        f"{len(mesh.faces)} faces, but the file says {len(corners)}",
    )
    low, high = corners.min(axis=(0, 1)), corners.max(axis=(0, 1))
    expected = ((corners - (low + high) / 2) / ((high - low).max() / 2))[..., [2, 0, 1]].mean(
        axis=1
    )
    ours = mesh.vertices[mesh.faces].mean(axis=1)
    distance = [
        np.abs(np.sort(a @ axis) - np.sort(b @ axis)).max()
        for a, b in [(ours, expected)]
        for axis in np.eye(3)
    ]
    require(max(distance) < 1e-4, f"faces are up to {max(distance):.3g} from where the file says")


def meshes(kind: str) -> list[bytes]:
    """A box with a texture, with colours of the vertices, of the faces, and as two objects of a
    scene.
    """
    import trimesh
    from PIL import Image

    image = Image.fromarray(np.random.default_rng(0).integers(0, 255, (4, 4, 3), dtype=np.uint8))
    textured, by_vertex, by_face = (trimesh.creation.box((1, 0.7, 0.5)) for _ in range(3))
    material = (
        trimesh.visual.material.PBRMaterial(baseColorTexture=image) if kind == "glb" else None
    )
    textured.visual = trimesh.visual.TextureVisuals(
        uv=textured.vertices[:, :2] + 0.5, image=image, material=material
    )
    by_vertex.visual.vertex_colors = np.random.default_rng(1).integers(0, 255, (8, 4))
    by_face.visual.face_colors = np.random.default_rng(2).integers(0, 255, (12, 4))
    moved = trimesh.transformations.translation_matrix([0, 2, 0])
    scene = trimesh.Scene([by_vertex])
    scene.add_geometry(textured, transform=moved)
    sources = {
        "glb": [textured, by_vertex, scene],
        "obj": [textured, by_vertex],
        "ply": [by_vertex, by_face],
    }
    seeds = [source.export(file_type=kind) for source in sources.get(kind, [by_vertex])]
    return [seed.encode() if isinstance(seed, str) else seed for seed in seeds]


# ---- checkpoints ---------------------------------------------------------------------------------


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
    plain = io.BytesIO()
    torch.save(content, plain)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "last.ckpt")
        save_file(path, content)
        return [path.read_bytes(), plain.getvalue()]


def exercise_checkpoint(path: Path) -> None:
    """Read, put into a cloud and drawn; nothing is read whose checksums don't hold, or that the
    file is too small for.
    """
    checkpoint = load_checkpoint(path)
    strictly(oracles.checked_archive, path)
    tensors = list(_tensors(checkpoint))
    stored = sum(
        {t.untyped_storage().data_ptr(): t.untyped_storage().nbytes() for t in tensors}.values()
    )
    require(
        stored <= path.stat().st_size,
        f"{stored} bytes of tensors from a file of {path.stat().st_size}",
    )
    require(
        all(t.numel() * t.element_size() <= path.stat().st_size for t in tensors),
        "a tensor is larger than the file",
    )
    geometry = GaussianCloud({})
    state = {
        key.removeprefix("geometry."): value
        for key, value in checkpoint["state_dict"].items()
        if key.startswith("geometry.")
    }
    with lightning_errors(str(path)):
        geometry.load_state_dict(state)
    if len(geometry):
        require_picture(geometry)


def _tensors(value: Any) -> Iterator[torch.Tensor]:
    if isinstance(value, torch.Tensor):
        yield value
    elif isinstance(value, (dict, list, tuple)):
        for item in value.values() if isinstance(value, dict) else value:
            yield from _tensors(item)


# ---- configurations and command lines ------------------------------------------------------------


def configurations() -> list[bytes]:
    """Those that say everything, or all but the prompt."""
    sources = [
        (ROOT / "configs" / f"{name}.yaml").read_bytes() for name in ("demo", "gaussiandreamer")
    ]
    return [source.replace(b"???", b'"a fox: red"') for source in sources]


def exercise_configuration(path: Path) -> None:
    """What is accepted, written and read again is the same run."""
    check_same_run(config.load_config(path), path)


def check_same_run(cfg: Any, path: Path) -> None:
    check_config(cfg)
    parsed = path.with_name("parsed.yaml")
    config.dump_config(parsed, cfg)
    again = config.load_config(parsed)
    ours, theirs = (config.OmegaConf.to_container(c, resolve=False) for c in (cfg, again))
    for key in ("resume", "new_folder"):  # of this run alone
        ours[key] = theirs[key] = None
    require(repr(ours) == repr(theirs), "parsed.yaml isn't the same run")


COMMANDS = [
    "--config\ndemo.yaml\n--train\n--gpu\ncpu\ntrainer.max_steps=1200\n"
    "system.prompt_processor.prompt=a fox: red, 1984\nseed=3\ntag=t",
    "--config\ndemo.yaml\n--config\ndemo-draft.yaml\n--export\n"
    "resume=outputs/demo/x/ckpts/last.ckpt\nsystem.geometry.prior_type=random-prior\n"
    "data.elevation_range=[-10,60]\nsystem.geometry.densify={enabled: true, start: 9, stop: 99}",
    "--config\ngaussiandreamer\n--test\n--verbose\nsystem.prompt_processor.prompt=1984\nname=a "
    "b\nuse_timestamp=false\n"
    "system.guidance.max_step_percent=[0,0.98,0.5,500]\n"
    "system.geometry.lr_means=1e-4\nsystem.exporter.formats=[ply,points]\ncheckpoint.save_last=true\ndata.batch_size=${seed}\nseed=2",
]


def exercise_command(path: Path) -> None:
    """Exit code 2 with one message, or 0 where nothing but the work itself would follow."""
    arguments = path.read_bytes().decode("utf-8", errors="surrogateescape").split("\n")
    arguments = [argument for argument in arguments if not argument.startswith("--typecheck")]
    out, err, environ = io.StringIO(), io.StringIO(), dict(os.environ)
    try:
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err), no_work():
            code = experiment.main(arguments)
    finally:
        os.environ.clear()
        os.environ.update(environ)
    require(code in (0, 2), f"exit code {code}")
    if code == 2:
        require(
            sum("error: " in line for line in err.getvalue().splitlines()) >= 1,
            "exit code 2 without a message",
        )
        raise UserError(err.getvalue())


@contextlib.contextmanager
def no_work() -> Iterator[None]:
    """Runs end where the work would begin, and leave the process's logging and warnings as they
    were.
    """
    run, logger = Run.run, logging.getLogger("threestudio_gaussiandreamer")
    handlers, propagate, level = list(logger.handlers), logger.propagate, logger.level
    Run.run = lambda self: 0
    try:
        with warnings.catch_warnings():
            yield
    finally:
        Run.run = run
        logger.handlers[:], logger.propagate = handlers, propagate
        logger.setLevel(level)


# ---- arrays, text, SPZ ---------------------------------------------------------------------------


def _saved(save: Callable, *arguments: Any, **named: Any) -> bytes:
    buffer = io.BytesIO()
    save(buffer, *arguments, **named)
    return buffer.getvalue()


MOTION = np.random.default_rng(0).normal(size=(2, 22, 3, 5)).astype(np.float32)
ROWS = np.random.default_rng(1).random((15, 6))


def motion_archives() -> list[bytes]:
    named = {
        "motion": MOTION,
        "text": np.array(["a walk", "ein Sprung ü"]),
        "lengths": np.array([5, 3]),
    }
    return [
        _saved(np.savez, **named),
        _saved(np.savez_compressed, **named),
        _saved(np.save, MOTION),
    ]


def exercise_motions(path: Path) -> None:
    motions = read_motions(str(path))
    samples, frames, joints, three = motions.positions.shape
    require(joints in (22, 24) and three == 3 and len(motions.lengths) == samples, "shapes")
    require(
        all(
            np.isfinite(p[:n]).all() and 0 < n <= frames
            for p, n in zip(motions.positions, motions.lengths, strict=True)
        ),
        "frames",
    )
    if path.read_bytes()[:6] == b"\x93NUMPY":
        require(
            strictly(oracles.npy_array, path).size == motions.positions.size, "numbers are missing"
        )


def point_archives() -> list[bytes]:
    named = {
        "points": ROWS[:, :3],
        "colors": (255 * ROWS[:, 3:]).astype(np.uint8),
        "normals": ROWS[:, :3].astype(np.float32),
    }
    return [_saved(np.savez, **named), _saved(np.savez_compressed, **named)]


def exercise_points(path: Path) -> None:
    require_points(PointCloudPrior({"path": str(path)})("a fox"))


def exercise_npy_points(path: Path) -> None:
    cloud = PointCloudPrior({"path": str(path)})("a fox")
    require_points(cloud)
    rows = strictly(oracles.npy_array, path)
    with np.errstate(over="ignore", invalid="ignore"):
        usable = (
            np.isfinite(rows[:, :3].astype(np.float32)).all(axis=1)
            if rows.dtype.kind in "fiu"
            else np.zeros(0)
        )
    require(len(cloud.points) <= len(usable) <= 1.06 * len(cloud.points) + 1, "rows are missing")


def texts() -> list[bytes]:
    points = b"\n".join(b" ".join(b"%.6f" % value for value in row[:3]) for row in ROWS)
    colored = b"\n".join(b",".join(b"%.6f" % value for value in row) for row in ROWS)
    scan = b"15\n" + b"\n".join(
        b"%.4f %.4f %.4f 12 %d %d %d" % (*row[:3], *(255 * row[3:]).astype(int)) for row in ROWS
    )
    return [points, b"x,y,z,r,g,b\n" + colored, scan]


def spz_files() -> list[bytes]:
    return [
        spz_bytes(some_gaussians(12, 0)),
        spz_bytes(some_gaussians(9, 1), comment="up: y"),
        spz_bytes(some_gaussians(3, 3)),
    ]


def exercise_spz(path: Path) -> None:
    arrays = read_spz(path)
    content = strictly(oracles.gunzipped, path)
    count = int.from_bytes(content[8:12], "little")
    require(len(arrays.means) == count, f"{len(arrays.means)} Gaussians, but the file says {count}")
    require(bool(usable(arrays).all()), "values aren't finite")
    if count:
        require_picture(cloud_of(arrays))


TARGETS: dict[str, Target] = {
    "ply-gaussians": Target(".ply", gaussian_plys, exercise_gaussians_ply, packing=mutations.PLY),
    "ply-points": Target(".ply", point_plys, exercise_points_ply, packing=mutations.PLY),
    "ply-mesh": Target(".ply", lambda: meshes("ply"), exercise_ply_mesh, packing=mutations.PLY),
    "glb": Target(".glb", lambda: meshes("glb"), exercise_glb, packing=mutations.GLB),
    "gltf-features": Target(
        ".glb", gltf_features.seeds, exercise_gltf_features, [gltf_features.other_file]
    ),
    "obj": Target(".obj", lambda: meshes("obj"), exercise_obj, TEXT),
    "stl": Target(".stl", lambda: meshes("stl"), exercise_mesh),
    "off": Target(".off", lambda: meshes("off"), exercise_mesh, TEXT),
    "checkpoint": Target(".ckpt", checkpoints, exercise_checkpoint, packing=mutations.ZIP),
    "configuration": Target(".yaml", configurations, exercise_configuration, TEXT, traced=False),
    "config-values": Target(
        ".txt",
        config_values.seeds,
        config_values.exercise,
        [config_values.hostile_option],
        traced=False,
    ),
    "checkpoint-content": Target(
        ".ckpt",
        checkpoint_content.seeds,
        lambda path: checkpoint_content.exercise(path, require_picture),
        [checkpoint_content.other_content],
    ),
    "command-line": Target(
        ".txt",
        lambda: [command.encode() for command in COMMANDS],
        exercise_command,
        TEXT,
        traced=False,
    ),
    "motion": Target(".npz", motion_archives, exercise_motions, packing=mutations.ZIP),
    "points-npz": Target(".npz", point_archives, exercise_points, packing=mutations.ZIP),
    "points-npy": Target(
        ".npy",
        lambda: [_saved(np.save, ROWS), _saved(np.save, ROWS[:, :3].astype(np.float32))],
        exercise_npy_points,
    ),
    "points-text": Target(".xyz", texts, exercise_points, TEXT),
    "spz": Target(".spz", spz_files, exercise_spz, packing=mutations.GZIP),
}
