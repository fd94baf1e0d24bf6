"""The memory that readers budget from headers is what they take."""

import tracemalloc

import pytest

from tests.helpers.object_clouds import ball
from threestudio_gaussiandreamer.formats import glb, sog
from threestudio_gaussiandreamer.formats.gaussian_files import FORMATS, StoredCloud, write_cloud

COUNT = 6000


@pytest.mark.parametrize("degree", [0, 3])
@pytest.mark.parametrize(("suffix", "module"), [(".sog", sog), (".glb", glb)])
def test_reading_takes_no_more_than_what_is_budgeted(tmp_path, suffix, module, degree):
    path = tmp_path / f"a{suffix}"
    write_cloud(str(path), StoredCloud(ball(COUNT, degree)))
    FORMATS[suffix].read(path)  # imports
    tracemalloc.start()
    FORMATS[suffix].read(path)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    each = module.DECODED_BYTES + module.DECODED_BYTES_PER_HARMONIC * (degree + 1) ** 2
    assert 0.3 * COUNT * each < peak < 1.05 * COUNT * each
