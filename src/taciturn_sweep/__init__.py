"""Sweeps: evaluate a problem on a grid of values with many processors, and store each result when it is finished.

``sweep`` has ``taciturn.sweep`` and its table, ``cluster`` the workers of a dask scheduler, and ``commands`` the
command ``sweep``.
"""
