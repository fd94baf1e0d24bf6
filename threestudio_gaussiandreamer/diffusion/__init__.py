"""Formulas of score distillation and of the exact score."""
