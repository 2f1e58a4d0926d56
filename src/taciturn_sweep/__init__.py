"""Grids of problems on many processors, with every result stored when it is finished.

``sweep`` has ``taciturn.sweep`` and its table, ``cluster`` the workers of a dask scheduler, and ``commands`` the
command ``sweep``.
"""
