"""Measure finished runs."""
