"""Prompts, prompt processors and view-dependent prompts."""
