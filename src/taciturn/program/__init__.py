"""Straight-line programs of one tick, and what runs them: NumPy (the meaning) and LLVM."""
