"""Every registered exporter of this package satisfies one contract; its files read back as
exported, upright.
"""

import importlib
import pkgutil
import sys
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from threestudio_gaussiandreamer import exporters, register_parts
from threestudio_gaussiandreamer.core.errors import UserError
from threestudio_gaussiandreamer.exporters.files import outputs_of
from threestudio_gaussiandreamer.formats import ply
from threestudio_gaussiandreamer.formats.gaussian_files import read_cloud, write_cloud
from threestudio_gaussiandreamer.formats.obj import write_obj
from threestudio_gaussiandreamer.formats.ply import read_comments
from threestudio_gaussiandreamer.formats.spz import read_spz
from threestudio_gaussiandreamer.gaussians.gaussians import Gaussians
from threestudio_gaussiandreamer.gaussians.sh import sh_to_colors
from threestudio_gaussiandreamer.host import (
    BaseGeometry,
    Exporter,
    ExporterOutput,
    find,
    names,
    register,
)
from threestudio_gaussiandreamer.launch.part_kinds import check_kind
from threestudio_gaussiandreamer.meshes.load import load_mesh
from threestudio_gaussiandreamer.meshes.write import write_textured_mesh
from threestudio_gaussiandreamer.training.export import save

register_parts()
for module in pkgutil.iter_modules(exporters.__path__):
    importlib.import_module(f"{exporters.__name__}.{module.name}")

WRITERS = {
    "ply": lambda path, stored: write_cloud(str(path), stored, ".ply"),
    "spz": lambda path, stored, version: write_cloud(
        str(path), stored, ".spz", spz_version=version
    ),
    "gaussians": lambda path, stored, suffix: write_cloud(str(path), stored, suffix),
    "points": lambda path, cloud: ply.write_points(path, cloud),
    "surface": lambda path, surface: write_obj(path, surface),
    "textured_mesh": lambda path, mesh, unlit: write_textured_mesh(path, mesh, unlit=unlit),
}
SMALL = {
    "mesh-exporter": dict(faces=200, texture=64, views=8, view_size=64, resolution=16),
}
"""Options that make an exporter fast."""
EXPORTERS = sorted(
    {
        find(name): name  # one name of each
        for name in names()
        if name.endswith("-exporter") and find(name).__module__.startswith(exporters.__name__)
    }.values()
)


class Cloud(BaseGeometry):
    """The attributes of a geometry that exporters read: the parameters, with gradients."""


def geometry(count=40, degree=1):
    generator, cloud = torch.Generator().manual_seed(0), Cloud({})
    for name, shape in dict(
        means=(3,), sh=((degree + 1) ** 2, 3), logit_opacities=(), log_scales=(3,), quats=(4,)
    ).items():
        setattr(cloud, name, torch.nn.Parameter(torch.randn(count, *shape, generator=generator)))
    return cloud


def build(name, source=None, **options):
    options = SMALL.get(name, {}) | options
    return find(name)(options, geometry=source or geometry(), material=None, background=None)


def write(output, folder):
    path = folder / output.save_name
    WRITERS[output.save_type](path, **output.params)
    return path


@pytest.mark.parametrize("name", EXPORTERS)
class TestContract:
    def test_gives_files_that_the_savers_write(self, name, tmp_path):
        outputs = build(name)()
        assert outputs and all(isinstance(output, ExporterOutput) for output in outputs)
        paths = [write(output, tmp_path) for output in outputs]
        assert len(set(paths)) == len(paths) and all(path.stat().st_size > 0 for path in paths)

    def test_an_empty_cloud_is_exported(self, name, tmp_path):
        if name == "mesh-exporter":
            pytest.skip("a mesh needs a surface: tests/surface/test_textured.py")
        paths = [write(output, tmp_path) for output in build(name, geometry(count=0))()]
        assert paths and all(path.is_file() for path in paths)

    def test_the_geometry_is_not_changed(self, name):
        source = geometry()
        before = {key: value.detach().clone() for key, value in source.named_parameters()}
        build(name, source)()
        assert all(torch.equal(before[key], value) for key, value in source.named_parameters())

    def test_save_video_is_an_option(self, name):
        assert build(name, save_video=True).cfg.save_video is True


@pytest.mark.parametrize("degree", [0, 3])
def test_gaussians_read_back_bit_for_bit(tmp_path, degree):
    source = geometry(degree=degree)
    (output,) = build("ply-exporter", source, up="z")()
    read = ply.read_gaussians(write(output, tmp_path))
    for name in Gaussians._fields:
        assert getattr(read, name).tobytes() == getattr(source, name).detach().numpy().tobytes(), (
            name
        )


@pytest.mark.parametrize("name", ["ply", "spz"])
@pytest.mark.parametrize("degree", [0, 3])
def test_gaussians_are_exported_in_the_axes_of_the_viewers(tmp_path, name, degree):
    """One Gaussian high above the front: -y and -z in 3DGS' axes, +y and +z in SPZ's."""
    source = geometry(1, degree)
    source.means.data[:] = torch.tensor([[4.0, 1.0, 2.0]])  # front, left, up in our world
    (output,) = build(f"{name}-exporter", source)()
    path = write(output, tmp_path)
    raw = ply.read_gaussians(path) if name == "ply" else read_spz(path)
    expected = [[1, -2, -4]] if name == "ply" else [[1, 2, 4]]
    np.testing.assert_allclose(raw.means, expected, atol=1e-3)
    stored = read_cloud(str(path))
    assert stored.up == ("-y" if name == "ply" else "y")
    back, rounding = stored.in_axes("z").gaussians, 1e-5 if name == "ply" else 0.05
    np.testing.assert_allclose(back.means, source.means.detach(), atol=1e-3)
    view = torch.tensor([[1.0, 0.2, 0.3]])
    colors = [sh_to_colors(torch.as_tensor(sh), view) for sh in (back.sh, source.sh.detach() * 1.0)]
    if name == "ply":  # SPZ rounds harmonics and clips them
        torch.testing.assert_close(*colors, atol=rounding, rtol=0)


def test_a_ply_without_its_comment_is_read_upright(tmp_path):
    source = geometry()
    (output,) = build("ply-exporter", source)()
    path = write(output, tmp_path)
    path.write_bytes(path.read_bytes().replace(b"comment up: -y\n", b""))
    read = read_cloud(str(path)).in_axes("z").gaussians
    np.testing.assert_array_equal(read.means, source.means.detach().numpy())
    prior = find("gaussians-prior")({"path": str(path)}).gaussians("")
    np.testing.assert_array_equal(prior.means, source.means.detach().numpy())
    points = find("point-cloud-prior")({"path": str(path)})("").points
    np.testing.assert_array_equal(points, source.means.detach().numpy())


def test_axes_of_the_world_can_be_asked_for(tmp_path):
    source = geometry()
    outputs = build(
        "gaussiandreamer-exporter",
        source,
        formats=["ply", "surface", "points"],
        options={"surface": {"up": "-y", "resolution": 16}},
        up="z",
    )()
    path = write(outputs[0], tmp_path)
    assert read_comments(path) == ["up: z"] and read_cloud(str(path)).up == "z"
    assert ply.read_gaussians(path).means.tobytes() == source.means.detach().numpy().tobytes()
    world, camera = (
        build("surface-exporter", source, resolution=16, up=up)()[0].params["surface"].vertices
        for up in ("z", "-y")
    )
    np.testing.assert_allclose(camera, world[:, [1, 2, 0]] * [1, -1, -1], atol=1e-6)
    np.testing.assert_array_equal(outputs[1].params["surface"].vertices, camera)
    for name in ("ply", "surface", "gaussiandreamer"):
        with pytest.raises(UserError, match="unknown .*up 'x'"):
            build(f"{name}-exporter", up="x")


def test_the_exported_surface_is_read_back_in_the_pose_of_the_gaussians(tmp_path):
    """A tall object with a nose in front: z is its longest side, the nose points to +x."""
    source, rng = geometry(400, 0), torch.Generator().manual_seed(1)
    source.means.data = torch.rand(400, 3, generator=rng) * torch.tensor([0.3, 0.5, 2.0])
    source.means.data[:60] = torch.rand(60, 3, generator=rng) * 0.2 + torch.tensor([0.3, 0.1, 0.2])
    source.log_scales.data[:], source.logit_opacities.data[:] = -3, 4
    (output,) = build("surface-exporter", source, resolution=48)()
    raw = output.params["surface"].vertices
    assert np.ptp(raw, axis=0).argmax() == 1  # y up in the file
    mesh = load_mesh(write(output, tmp_path))
    size = np.ptp(mesh.vertices, axis=0)
    assert size.argmax() == 2 and size.argmin() == 0 or size[2] > 3 * size[:2].max()
    low = mesh.vertices[mesh.vertices[:, 2] < -0.6]
    assert low[:, 0].max() > 0.1 and low[:, 0].max() == mesh.vertices[:, 0].max()


def test_points_read_back_bit_for_bit(tmp_path):
    source = geometry()
    (output,) = build("points-exporter", source)()
    read, cloud = ply.read_points(write(output, tmp_path)), output.params["cloud"]
    assert (
        read.points.tobytes() == cloud.points.tobytes() == source.means.detach().numpy().tobytes()
    )
    assert read.colors.tobytes() == cloud.colors.tobytes()
    np.testing.assert_allclose(
        cloud.colors, (0.5 + 0.28209479 * source.sh[:, 0].detach().numpy()).clip(0, 1), atol=1e-6
    )


def test_faint_points_can_be_left_out():
    source = geometry()
    (output,) = build("points-exporter", source, min_opacity=0.5)()
    np.testing.assert_array_equal(
        output.params["cloud"].points, source.means.detach()[source.logit_opacities >= 0].numpy()
    )
    with pytest.raises(UserError, match="min_opacity"):
        build("points-exporter", min_opacity=1.5)


def test_harmonics_can_be_padded():
    source = geometry(degree=0)
    (output,) = build("ply-exporter", source, pad_sh_degree=3)()
    sh = output.params["stored"].gaussians.sh
    assert sh.shape == (40, 16, 3) and not sh[:, 1:].any()
    with pytest.raises(UserError, match="pad_sh_degree"):
        build("ply-exporter", pad_sh_degree=4)


def test_nothing_that_is_not_finite_is_exported_and_that_is_reported_once(tmp_path, caplog):
    source = geometry(degree=1)
    with torch.no_grad():
        source.means[3], source.log_scales[5, 1] = float("nan"), float("inf")
        source.logit_opacities[7], source.sh[9, 2, 0] = float("inf"), float("-inf")
    options = {"surface": {"resolution": 16}}
    formats = ["ply", "spz", "points", "surface"]
    outputs = build("gaussiandreamer-exporter", source, formats=formats, options=options)()
    files = [write(output, tmp_path) for output in outputs]
    assert caplog.text.count("3 of 40 Gaussians hold NaN or infinity: left out") == 1
    assert len([r for r in caplog.records if r.levelname == "WARNING"]) == 1
    for gaussians in (ply.read_gaussians(files[0]), read_spz(files[1])):
        assert len(gaussians.means) == 37
        assert all(np.isfinite(values).all() for values in gaussians)
    assert len(ply.read_points(files[2]).points) == 37
    assert "nan" not in files[3].read_text() and "inf" not in files[3].read_text()
    bad = outputs[3].params["surface"]._replace(vertices=np.full((1, 3), np.nan))
    with pytest.raises(UserError, match="isn't written"):
        write_obj(tmp_path / "bad.obj", bad)


def test_one_gaussian_beyond_the_range_of_spz_aborts_no_export(tmp_path, caplog):
    source = geometry()
    with torch.no_grad():
        source.means[3, 0] = 3e7
    outputs = build("gaussiandreamer-exporter", source, formats=["spz", "ply"])()
    spz_file, ply_file = (write(output, tmp_path) for output in outputs)
    assert "1 of 40 Gaussians are farther away" in caplog.text
    assert len(read_spz(spz_file).means) == len(ply.read_gaussians(ply_file).means) == 40


class TestBundle:
    def test_gives_the_files_of_every_format_in_order(self):
        outputs = build("gaussiandreamer-exporter")()
        assert [output.save_type for output in outputs] == ["ply", "spz", "points"]
        assert [
            output.save_type for output in build("gaussiandreamer-exporter", formats=["points"])()
        ] == ["points"]

    def test_hands_options_on(self):
        (output,) = build(
            "gaussiandreamer-exporter",
            formats=["ply"],
            options={"ply": {"pad_sh_degree": 2, "save_name": "x.ply"}},
        )()
        assert (
            output.params["stored"].gaussians.sh.shape == (40, 9, 3) and output.save_name == "x.ply"
        )

    def test_mistakes_are_named_when_built(self):
        with pytest.raises(UserError, match="unknown formats.1. 'pyl': did you mean 'ply'"):
            build("gaussiandreamer-exporter", formats=["points", "pyl"])
        with pytest.raises(UserError, match="gaussiandreamer"):
            build("gaussiandreamer-exporter", formats=["gaussiandreamer"])
        with pytest.raises(UserError, match="options.points"):
            build("gaussiandreamer-exporter", formats=["ply"], options={"points": {}})
        with pytest.raises((UserError, TypeError), match="pad"):
            build("gaussiandreamer-exporter", formats=["ply"], options={"ply": {"pad": 2}})

    @pytest.mark.parametrize(
        ("options", "message"),
        [
            ({"spz": {"save_name": "gaussians.ply"}}, "is the file of the format ply"),
            ({"ply": {"save_name": "Points.PLY"}}, "is the file of the format ply"),
            ({"ply": {"save_name": "x\0.ply"}}, "at most 255 bytes and no NUL"),
            ({"ply": {"save_name": "ü" * 128}}, "at most 255 bytes and no NUL"),
            ({"ply": {"save_name": "pruned"}}, "a name that a run uses itself"),
            ({"ply": {"save_name": "a/b.ply"}}, "without folders"),
        ],
    )
    def test_a_name_that_would_fail_or_overwrite_is_named_when_built(self, options, message):
        with pytest.raises(UserError, match=f"options.{'|'.join(options)}|options.points") as info:
            build("gaussiandreamer-exporter", formats=["ply", "spz", "points"], options=options)
        assert message in str(info.value)


@pytest.mark.parametrize("name", ["compressed-ply", "sog", "glb"])
def test_other_formats_read_back_the_right_way_up(tmp_path, name):
    source = geometry(60, 1)
    source.log_scales.data -= 3
    (output,) = build(f"{name}-exporter", source)()
    read = read_cloud(str(write(output, tmp_path))).in_axes("z").gaussians
    means = source.means.detach().numpy()
    order = [np.abs(means - mean).sum(axis=1).argmin() for mean in read.means]
    assert sorted(order) == list(range(60))
    np.testing.assert_allclose(read.means, means[order], atol=0.01)


@pytest.mark.parametrize(
    ("name", "file", "head"), [("glb", "a.spz.glb", b"glTF"), ("usda", "a.usdz", b"PK")]
)
def test_the_extension_selects_a_variant(tmp_path, name, file, head):
    (output,) = build(f"{name}-exporter", geometry(60, 1), save_name=file)()
    path = write(output, tmp_path)
    assert path.read_bytes().startswith(head) and path.name == file
    assert len(read_cloud(str(path)).gaussians.means) == 60


def test_the_axis_of_a_mesh_is_for_its_obj(monkeypatch, tmp_path):
    """glTF is y up by definition, whatever ``up`` says."""
    pytest.importorskip("skimage")
    source, rng = geometry(400, 0), torch.Generator().manual_seed(1)
    source.means.data = torch.rand(400, 3, generator=rng) * torch.tensor([0.3, 0.5, 2.0])
    source.log_scales.data[:], source.logit_opacities.data[:] = -3, 4
    small = dict(method="density", resolution=32, views=8, view_size=64, texture=64, faces=200)
    outputs = build("gaussiandreamer-mesh-exporter", source, up="z", **small)()
    tall = {
        output.save_name: np.ptp(output.params["mesh"].vertices, axis=0).argmax()
        for output in outputs
    }
    assert tall == {"mesh.glb": 1, "mesh.obj": 2}


def test_the_version_of_spz_is_an_option(tmp_path):
    pytest.importorskip("zstandard")
    (output,) = build("spz-exporter", version=4)()
    assert write(output, tmp_path).read_bytes()[:8] == b"NGSP\4\0\0\0"
    with pytest.raises(UserError, match="version"):
        build("spz-exporter", version=2)


def test_a_version_that_cant_be_packed_is_found_before_the_run(monkeypatch):
    monkeypatch.setitem(sys.modules, "zstandard", None)
    with pytest.raises(UserError, match="pip install zstandard"):
        build("gaussiandreamer-exporter", formats=["spz"], options={"spz": {"version": 4}})


@pytest.mark.parametrize("returned", [None, [{"save_name": "a.txt"}], "a.txt"])
def test_an_exporter_must_return_outputs(returned):
    class Broken:
        def __call__(self):
            return returned

    kind = "entries of type dict" if isinstance(returned, list) else type(returned).__name__
    with pytest.raises(UserError, match=f"Broken returned {kind}; expected a list of Exporter"):
        outputs_of(Broken())


def test_an_unknown_save_type_names_those_that_the_system_has():
    system = SimpleNamespace(save_json=str, save_file=repr)
    with pytest.raises(UserError, match="save_type of an exporter 'txt': choose from file, json"):
        save(system, ExporterOutput("a.txt", "txt", {}), "a.txt", {})


@register("test-uncallable-exporter")
class Uncallable(Exporter):
    pass


@register("test-greedy-exporter")
class Greedy(Exporter):
    def __call__(self, everything):
        return []


@pytest.mark.parametrize(
    ("part", "said"),
    [(Uncallable, r"Uncallable has no __call__\(\)"), (Greedy, "Greedy has __call__.*called as")],
)
def test_an_exporter_that_cant_be_called_is_refused_before_the_run(part, said):
    name = f"test-{part.__name__.lower()}"
    with pytest.raises(UserError, match=f"system.exporter_type: {said}"):
        check_kind("system.exporter_type", f"{name}-exporter", part)
    with pytest.raises(UserError, match=said):
        build("gaussiandreamer-exporter", formats=["ply", name])
