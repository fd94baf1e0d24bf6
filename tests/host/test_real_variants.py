"""SDI and VSD against threestudio's own classes, by ``tests/helpers/threestudio_variants.py``.

The results agree where the choices do: the inversions start at timestep 0 and end at t; the LoRA is
given the same text as the UNet."""

import json

import pytest

from tests.helpers import real_host

pytestmark = real_host.NEEDED


@pytest.fixture(scope="module")
def errors(tmp_path_factory):
    folder = tmp_path_factory.mktemp("variants")
    printed = real_host.output_of("tests.helpers.threestudio_variants", folder)
    return json.loads(printed.splitlines()[-1])


@pytest.mark.parametrize(("variant", "count"), [("SDI", 9), ("VSD", 4)])
def test_it_is_threestudios(errors, variant, count):
    found = {name: values for name, values in errors.items() if name.startswith(variant)}
    assert len(found) == count
    assert all(error <= 1e-5 for values in found.values() for error in values.values()), found
