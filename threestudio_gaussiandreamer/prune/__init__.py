"""Prune a finished cloud to a budget: ``python -m threestudio_gaussiandreamer.prune IN OUT``."""

from .command import main
from .options import PruneOptions
from .pipeline import prune_to_budget, write_report

__all__ = ["PruneOptions", "main", "prune_to_budget", "write_report"]
