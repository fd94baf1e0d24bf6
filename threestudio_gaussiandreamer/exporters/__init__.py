"""Exporters: which files a trained cloud is written to, and how."""
