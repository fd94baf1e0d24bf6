"""Guidances: score distillation from a diffusion model or an exact score."""
