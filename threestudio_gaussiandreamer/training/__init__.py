"""Geometry, renderer, background, data and the system that trains them."""
