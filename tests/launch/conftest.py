"""Runs of the tiny system and of a tiny demo, in this process."""

from datetime import datetime

import pytest

import threestudio_gaussiandreamer
from tests.helpers import tiny_parts
from tests.helpers.gallery import only_run
from tests.launch.cases import DEMO, SMALL
from threestudio_gaussiandreamer.launch import run_folder
from threestudio_gaussiandreamer.launch.experiment import main


@pytest.fixture
def launch(folder, monkeypatch, capsys):
    """``launch("--train", overrides...)`` returns (exit code, stdout, stderr)."""
    monkeypatch.setattr(threestudio_gaussiandreamer, "register_parts", lambda: None)
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "")

    def run(*arguments: str, config: str = "tiny.yaml") -> tuple[int, str, str]:
        code = main(["--config", config, *arguments])
        captured = capsys.readouterr()
        return code, captured.out, captured.err

    return run


@pytest.fixture
def noon(monkeypatch):
    """Let every run begin in the same second."""

    class Noon(datetime):
        @classmethod
        def now(cls, tz=None):
            return cls(2026, 1, 31, 12)

    monkeypatch.setattr(run_folder, "datetime", Noon)


@pytest.fixture
def trained(launch):
    assert launch("--train")[0] == 0
    return only_run()


@pytest.fixture
def launch_demo(tmp_path, monkeypatch, capsys):
    """``launch_demo(overrides...)`` trains a tiny demo; returns (exit code, stderr)."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "")

    def run(*overrides: str, stage: str = "--train", config: str = str(DEMO)) -> tuple[int, str]:
        code = main(["--config", config, stage, "--gpu", "cpu", *SMALL, *overrides])
        return code, capsys.readouterr().err

    return run


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "tiny.yaml").write_text(tiny_parts.CONFIG)
    return tmp_path
