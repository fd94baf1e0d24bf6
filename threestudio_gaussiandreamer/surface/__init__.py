"""Convert Gaussians to a textured triangle mesh."""
