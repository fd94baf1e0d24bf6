"""Priors: initial point clouds from meshes, files and text-to-3D models."""
