"""Prompt lists to assets: a Ray worker per GPU, a ledger, a report."""
