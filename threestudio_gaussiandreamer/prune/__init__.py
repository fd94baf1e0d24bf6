"""Prune a finished cloud to a budget: ``python -m threestudio_gaussiandreamer.prune IN OUT``."""

from .command import PruneOptions, main, pruned, write_report

__all__ = ["PruneOptions", "main", "pruned", "write_report"]
