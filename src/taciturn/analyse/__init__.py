"""Exact analysis of loops."""
