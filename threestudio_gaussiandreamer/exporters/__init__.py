"""Exporters: write the trained cloud to files."""
