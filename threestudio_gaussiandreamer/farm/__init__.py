"""Prompt lists to assets: a Ray worker per GPU, a record per asset, a report."""
