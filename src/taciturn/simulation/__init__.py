"""Runs programs of loops: estimates with standard errors, and single trajectories."""
