"""Text that OmegaConf must return unchanged."""

import time

import pytest
from omegaconf import OmegaConf

from threestudio_gaussiandreamer.core.interpolation import escape
from threestudio_gaussiandreamer.launch.config_source import _protect_escaped


@pytest.mark.parametrize("text", ["${a}", "\\${a}", "x\\\\${", "\\\\", "${${", "a\\b ${c} \\\\${d"])
def test_escaped_text_is_read_back(text):
    assert OmegaConf.create({"text": escape(text)}).text == text


def test_a_sequence_of_backslashes_takes_linear_time():
    """100 kB from a file; a search that starts at every backslash takes a minute."""
    text = "\\" * 100_000
    started = time.process_time()
    assert escape(text) == text
    assert _protect_escaped(text + " \\${a}").startswith(text)
    assert time.process_time() - started < 1
