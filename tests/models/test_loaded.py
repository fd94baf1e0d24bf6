"""Networks that a process keeps."""

import pytest

from threestudio_gaussiandreamer.models import loaded as module
from threestudio_gaussiandreamer.models.loaded import keep_loaded, load_counts, loaded


@pytest.fixture(autouse=True)
def nothing_kept():
    yield
    keep_loaded(False)


def test_a_single_run_keeps_nothing():
    keep_loaded(False)
    one, other = loaded(("unet", "a"), object), loaded(("unet", "a"), object)
    assert one is not other and not module._kept


def test_a_network_is_loaded_once_for_each_key():
    keep_loaded()
    one = loaded(("unet", "a", "float32"), object)
    assert loaded(("unet", "a", "float32"), object) is one
    assert loaded(("unet", "a", "float16"), object) is not one
    assert loaded(("vae", "a", "float32"), object) is not one
    assert load_counts() == {"unet": 2, "vae": 1}


def test_a_failed_load_is_tried_again():
    def fail():
        raise ValueError("damaged")

    keep_loaded()
    with pytest.raises(ValueError):
        loaded(("unet", "a"), fail)
    assert loaded(("unet", "a"), lambda: 3) == 3 and load_counts() == {"unet": 1}
