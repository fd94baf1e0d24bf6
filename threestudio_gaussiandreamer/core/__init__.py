"""Utilities of every ring: errors, random streams, files, checkpoints, schedules."""
