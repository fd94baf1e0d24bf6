"""Every registered exporter of ours keeps the same contract; what is written reads back bit for
bit.
"""

import importlib
import pkgutil

import numpy as np
import pytest
import torch

from threestudio_gaussiandreamer import exporters
from threestudio_gaussiandreamer.core.errors import UserError
from threestudio_gaussiandreamer.formats import ply
from threestudio_gaussiandreamer.formats.spz import read_spz, write_spz
from threestudio_gaussiandreamer.gaussians.gaussians import Gaussians
from threestudio_gaussiandreamer.gaussians.surface import write_obj
from threestudio_gaussiandreamer.host import BaseGeometry, ExporterOutput, find, names

for module in pkgutil.iter_modules(exporters.__path__):
    importlib.import_module(f"{exporters.__name__}.{module.name}")

WRITERS = {
    "ply": ply.write_gaussians,
    "spz": lambda path, **arrays: write_spz(path, **arrays),
    "points": lambda path, cloud: ply.write_points(path, cloud),
    "surface": lambda path, surface: write_obj(path, surface),
}
EXPORTERS = sorted(
    name
    for name in names()
    if name.endswith("-exporter") and find(name).__module__.startswith(exporters.__name__)
)


class Cloud(BaseGeometry):
    """What exporters read of a geometry: the parameters, with gradients."""


def geometry(count=40, degree=1):
    generator, cloud = torch.Generator().manual_seed(0), Cloud({})
    for name, shape in dict(
        means=(3,), sh=((degree + 1) ** 2, 3), logit_opacities=(), log_scales=(3,), quats=(4,)
    ).items():
        setattr(cloud, name, torch.nn.Parameter(torch.randn(count, *shape, generator=generator)))
    return cloud


def build(name, source=None, **options):
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
    (output,) = build("ply-exporter", source)()
    assert all(
        isinstance(values, np.ndarray) and values.dtype == np.float32
        for values in output.params.values()
    )
    read = ply.read_gaussians(write(output, tmp_path))
    for name in Gaussians._fields:
        assert getattr(read, name).tobytes() == getattr(source, name).detach().numpy().tobytes(), (
            name
        )


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
    assert output.params["sh"].shape == (40, 16, 3) and not output.params["sh"][:, 1:].any()
    with pytest.raises(UserError, match="pad_sh_degree"):
        build("ply-exporter", pad_sh_degree=4)


def test_a_compact_file_leaves_out_what_it_cant_hold(tmp_path):
    source = geometry(degree=1)
    with torch.no_grad():
        source.means[3] = float("nan")
    (output,) = build("spz-exporter", source)()
    assert len(read_spz(write(output, tmp_path)).means) == 39


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
        assert output.params["sh"].shape == (40, 9, 3) and output.save_name == "x.ply"

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
