"""The command line: configuration, checks, trainer, checkpoints."""
