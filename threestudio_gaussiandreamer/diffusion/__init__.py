"""Formulas of score distillation and exact scores."""
