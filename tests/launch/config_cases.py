"""Helpers of the configuration tests."""

from threestudio_gaussiandreamer.launch.config import load_config


def load(*overrides: str):
    return load_config("tiny.yaml", cli_args=overrides)
