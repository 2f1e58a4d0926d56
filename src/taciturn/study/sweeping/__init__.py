"""Grids of problems, computed on many processors, stored, and continued after a stop.

``sweep`` builds the grid and returns labelled arrays (``table``: as text). ``cells`` computes its blocks on
``workers``, whose code must be the same (``identity``), and keeps each result in a ``store``.
"""
