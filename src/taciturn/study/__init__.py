"""Whole studies: evaluate, trade off, reproduce."""
