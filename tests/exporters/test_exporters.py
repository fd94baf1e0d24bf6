"""Every registered exporter satisfies one contract; its files read back as exported, upright."""

import importlib
import pkgutil
import sys

import numpy as np
import pytest
import torch

from tests.helpers.refusals import refused
from threestudio_gaussiandreamer import exporters, register_parts
from threestudio_gaussiandreamer.core.errors import UserError
from threestudio_gaussiandreamer.exporters.files import outputs_of
from threestudio_gaussiandreamer.formats import ply, spz
from threestudio_gaussiandreamer.formats.gaussian_files import read_cloud, write_cloud
from threestudio_gaussiandreamer.gaussians.gaussians import Gaussians
from threestudio_gaussiandreamer.gaussians.sh import sh_to_colors
from threestudio_gaussiandreamer.host import BaseGeometry, Exporter, ExporterOutput, find, register
from threestudio_gaussiandreamer.host import names as registered
from threestudio_gaussiandreamer.launch.parts import check_kind
from threestudio_gaussiandreamer.meshes.load import load_mesh
from threestudio_gaussiandreamer.meshes.write import write_obj, write_textured_mesh

register_parts()
for module in pkgutil.iter_modules(exporters.__path__):
    importlib.import_module(f"{exporters.__name__}.{module.name}")

WRITERS = {
    "ply": lambda path, stored: write_cloud(str(path), stored, ".ply"),
    "spz": lambda path, stored, version: write_cloud(str(path), stored, spz_version=version),
    "gaussians": lambda path, stored, suffix: write_cloud(str(path), stored, suffix),
    "points": lambda path, cloud: ply.write_points(path, cloud),
    "surface": lambda path, surface: write_obj(path, surface),
    "textured_mesh": lambda path, mesh, unlit: write_textured_mesh(path, mesh, unlit=unlit),
}
SMALL = {"mesh-exporter": dict(faces=200, texture=64, views=8, view_size=64, resolution=16)}
"""Options that make an exporter fast."""
OURS = [name for name in registered() if name.endswith("-exporter")]
OURS = [name for name in OURS if find(name).__module__.startswith(exporters.__name__)]
EXPORTERS = sorted({find(name): name for name in OURS}.values())  # one name of each


class Cloud(BaseGeometry):
    """The attributes of a geometry that exporters read: the parameters, with gradients."""


def geometry(count=40, degree=1):
    generator, cloud = torch.Generator().manual_seed(0), Cloud({})
    shapes = dict(means=(3,), sh=((degree + 1) ** 2, 3), logit_opacities=())
    for name, shape in (shapes | dict(log_scales=(3,), quats=(4,))).items():
        setattr(cloud, name, torch.nn.Parameter(torch.randn(count, *shape, generator=generator)))
    return cloud


def build(name, source=None, **options):
    options = SMALL.get(name, {}) | options
    return find(name)(options, geometry=source or geometry(), material=None, background=None)


def tall():
    """Return 400 points in a tall box, whose longest side is z."""
    source, rng = geometry(400, 0), torch.Generator().manual_seed(1)
    source.means.data = torch.rand(400, 3, generator=rng) * torch.tensor([0.3, 0.5, 2.0])
    source.log_scales.data[:], source.logit_opacities.data[:] = -3, 4
    return source


def write(output, folder):
    path = folder / output.save_name
    WRITERS[output.save_type](path, **output.params)
    return path


def values_of(source):
    return {name: getattr(source, name).detach().numpy() for name in Gaussians._fields}


@pytest.mark.parametrize("name", EXPORTERS)
def test_the_contract_of_exporters(name, tmp_path):
    """Files that the savers write, a geometry that is left as it is, also an empty one."""
    source = geometry()
    before = {key: value.copy() for key, value in values_of(source).items()}
    exporter = build(name, source, save_video=True)
    outputs = exporter()
    assert exporter.cfg.save_video is True
    assert outputs and all(isinstance(output, ExporterOutput) for output in outputs)
    paths = [write(output, tmp_path) for output in outputs]
    assert len(set(paths)) == len(paths) and all(path.stat().st_size > 0 for path in paths)
    assert all(np.array_equal(before[key], value) for key, value in values_of(source).items())
    if name != "mesh-exporter":  # a mesh needs a surface: tests/surface/test_textured.py
        paths = [write(output, tmp_path) for output in build(name, geometry(count=0))()]
        assert paths and all(path.is_file() for path in paths)


def test_gaussians_and_points_read_back_bit_for_bit(tmp_path):
    source = geometry(degree=3)
    (output,) = build("ply-exporter", source, up="z")()
    read = ply.read_gaussians(write(output, tmp_path))
    for name, values in values_of(source).items():
        assert getattr(read, name).tobytes() == values.tobytes(), name
    (output,) = build("points-exporter", source)()
    points, cloud = ply.read_points(write(output, tmp_path)), output.params["cloud"]
    assert points.points.tobytes() == cloud.points.tobytes() == read.means.tobytes()
    assert points.colors.tobytes() == cloud.colors.tobytes()
    expected = (0.5 + 0.28209479 * read.sh[:, 0]).clip(0, 1)
    np.testing.assert_allclose(cloud.colors, expected, atol=1e-6)


@pytest.mark.parametrize("name", ["ply", "spz"])
def test_gaussians_are_exported_in_the_axes_of_the_viewers(tmp_path, name):
    """One Gaussian high above the front: -y and -z in 3DGS' axes, +y and +z in SPZ's."""
    source = geometry(1, 3)
    source.means.data[:] = torch.tensor([[4.0, 1.0, 2.0]])  # front, left, up in our world
    (output,) = build(f"{name}-exporter", source)()
    path = write(output, tmp_path)
    raw = ply.read_gaussians(path) if name == "ply" else spz.read_spz(path)[0]
    expected = [[1, -2, -4]] if name == "ply" else [[1, 2, 4]]
    np.testing.assert_allclose(raw.means, expected, atol=1e-3)
    stored = read_cloud(str(path))
    assert stored.up == ("-y" if name == "ply" else "y")
    back = stored.in_axes("z").gaussians
    np.testing.assert_allclose(back.means, source.means.detach(), atol=1e-3)
    view = torch.tensor([[1.0, 0.2, 0.3]])
    colors = [sh_to_colors(torch.as_tensor(sh), view) for sh in (back.sh, source.sh.detach() * 1.0)]
    if name == "ply":  # SPZ rounds harmonics and clips them
        torch.testing.assert_close(*colors, atol=1e-5, rtol=0)


def test_axes_of_the_world_can_be_asked_for(tmp_path):
    source = geometry()
    surface = {"surface": {"up": "-y", "resolution": 16}}
    bundle = {"formats": ["ply", "surface", "points"], "options": surface, "up": "z"}
    outputs = build("gaussiandreamer-exporter", source, **bundle)()
    assert [output.save_type for output in outputs] == ["ply", "surface", "points"]
    path = write(outputs[0], tmp_path)
    assert ply.read_comments(path) == ["up: z"] and read_cloud(str(path)).up == "z"
    assert ply.read_gaussians(path).means.tobytes() == source.means.detach().numpy().tobytes()
    world, camera = (
        build("surface-exporter", source, resolution=16, up=up)()[0].params["surface"].vertices
        for up in ("z", "-y")
    )
    np.testing.assert_allclose(camera, world[:, [1, 2, 0]] * [1, -1, -1], atol=1e-6)
    np.testing.assert_array_equal(outputs[1].params["surface"].vertices, camera)
    for name in ("ply", "surface", "gaussiandreamer"):
        refused("unknown .*up 'x'", build, f"{name}-exporter", up="x")


def test_the_exported_surface_is_read_back_in_the_pose_of_the_gaussians(tmp_path):
    """A tall object with a nose in front, which points to +x."""
    source, rng = tall(), torch.Generator().manual_seed(2)
    source.means.data[:60] = torch.rand(60, 3, generator=rng) * 0.2 + torch.tensor([0.3, 0.1, 0.2])
    (output,) = build("surface-exporter", source, resolution=48)()
    raw = output.params["surface"].vertices
    assert np.ptp(raw, axis=0).argmax() == 1  # y up in the file
    mesh = load_mesh(write(output, tmp_path))
    size = np.ptp(mesh.vertices, axis=0)
    assert size.argmax() == 2 and size.argmin() == 0 or size[2] > 3 * size[:2].max()
    low = mesh.vertices[mesh.vertices[:, 2] < -0.6]
    assert low[:, 0].max() > 0.1 and low[:, 0].max() == mesh.vertices[:, 0].max()


def test_options_of_points_and_of_a_ply():
    source = geometry(degree=0)
    (output,) = build("points-exporter", source, min_opacity=0.5)()
    kept = source.means.detach()[source.logit_opacities >= 0].numpy()
    np.testing.assert_array_equal(output.params["cloud"].points, kept)
    bundle = {"formats": ["ply"], "options": {"ply": {"pad_sh_degree": 3, "save_name": "x.ply"}}}
    (output,) = build("gaussiandreamer-exporter", source, **bundle)()
    sh = output.params["stored"].gaussians.sh
    assert output.save_name == "x.ply"
    assert sh.shape == (40, 16, 3) and not sh[:, 1:].any()
    (output,) = build("ply-exporter", geometry(degree=2), pad_sh_degree=1)()
    assert output.params["stored"].gaussians.sh.shape == (40, 9, 3)  # never cuts
    for name, option in ("points", {"min_opacity": 1.5}), ("ply", {"pad_sh_degree": 4}):
        refused(next(iter(option)), build, f"{name}-exporter", **option)


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
    for gaussians in (ply.read_gaussians(files[0]), spz.read_spz(files[1])[0]):
        assert len(gaussians.means) == 37
        assert all(np.isfinite(values).all() for values in gaussians)
    assert len(ply.read_points(files[2]).points) == 37
    assert "nan" not in files[3].read_text() and "inf" not in files[3].read_text()
    bad = outputs[3].params["surface"]._replace(vertices=np.full((1, 3), np.nan))
    refused("isn't written", write_obj, tmp_path / "bad.obj", bad)


@pytest.mark.parametrize(
    ("formats", "options", "message"),
    [
        ("points,pyl", {}, "unknown formats.1. 'pyl': did you mean 'ply'"),
        ("gaussiandreamer", {}, "gaussiandreamer"),
        ("ply", {"points": {}}, "options.points"),
        ("ply", {"ply": {"pad": 2}}, "options.ply.*pad"),
        ("ply,spz", {"spz": {"save_name": "gaussians.ply"}}, "is the file of the format ply"),
        ("ply,points", {"ply": {"save_name": "Points.PLY"}}, "is the file of the format ply"),
        ("ply", {"ply": {"save_name": "x\0.ply"}}, "options.ply.*at most 255 bytes and no NUL"),
        ("ply", {"ply": {"save_name": "ü" * 128}}, "options.ply.*at most 255 bytes and no NUL"),
        ("ply", {"ply": {"save_name": "pruned"}}, "other than pruned"),
        ("ply", {"ply": {"save_name": "a/b.ply"}}, "options.ply.*without folders"),
    ],
)
def test_mistakes_are_named_when_built(formats, options, message):
    with pytest.raises((UserError, TypeError), match=message):
        build("gaussiandreamer-exporter", formats=formats.split(","), options=options)


@pytest.mark.parametrize(
    ("name", "file", "head"), [("glb", "a.spz.glb", b"glTF"), ("usda", "a.usdz", b"PK")]
)
def test_the_extension_selects_a_variant(tmp_path, name, file, head):
    (output,) = build(f"{name}-exporter", geometry(60, 1), save_name=file)()
    path = write(output, tmp_path)
    assert path.read_bytes().startswith(head) and path.name == file
    assert len(read_cloud(str(path)).gaussians.means) == 60


def test_the_axis_of_a_mesh_is_for_its_obj():
    """glTF is y up by definition, whatever ``up`` says."""
    pytest.importorskip("skimage")
    small = dict(method="density", resolution=32, views=8, view_size=64, texture=64, faces=200)
    outputs = build("gaussiandreamer-mesh-exporter", tall(), up="z", **small)()
    sizes = {output.save_name: np.ptp(output.params["mesh"].vertices, axis=0) for output in outputs}
    longest = {name: size.argmax() for name, size in sizes.items()}
    assert longest == {"mesh.glb": 1, "mesh.obj": 2}


def test_the_version_of_spz_is_an_option(tmp_path, monkeypatch):
    refused("version", build, "spz-exporter", version=2)
    pytest.importorskip("zstandard")
    (output,) = build("spz-exporter", version=4)()
    assert write(output, tmp_path).read_bytes()[:8] == b"NGSP\4\0\0\0"
    monkeypatch.setitem(sys.modules, "zstandard", None)
    with pytest.raises(UserError, match="pip install zstandard"):  # before the run
        build("gaussiandreamer-exporter", formats=["spz"], options={"spz": {"version": 4}})


def test_an_exporter_must_return_outputs():
    """That it returns nothing is in tests/launch/test_author_mistakes.py."""
    for returned in ([{"save_name": "a.txt"}], "a.txt"):
        with pytest.raises(UserError, match="function returned (list|str); expected a list"):
            outputs_of(lambda returned=returned: returned)


@register("test-greedy-exporter")
class Greedy(Exporter):
    def __call__(self, everything):
        return []


def test_an_exporter_that_cant_be_called_is_refused_before_the_run():
    said = "Greedy has __call__.*called as"
    with pytest.raises(UserError, match=f"system.exporter_type: {said}"):
        check_kind("system.exporter_type", "test-greedy-exporter", Greedy)
    refused(said, build, "gaussiandreamer-exporter", formats=["ply", "test-greedy"])
