"""Convert files of Gaussians between formats and the axes of their producers."""
