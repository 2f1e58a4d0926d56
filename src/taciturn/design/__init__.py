"""Policies, one family per file; each carries its guarantee."""
