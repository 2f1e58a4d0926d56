"""Studies of problems: evaluate, tradeoff, tune, compare, describe.

A study takes a ``Problem``, designs its policy, chooses the method with the least predicted work for the requested
error, and returns frozen data with a JSON document, tables and figures.

Read the modules in this order:

1. ``evaluate`` with ``measure`` (choice of the method), and ``evaluation`` (its result). ``describe``: before that.
2. ``periodic`` and ``periodic_links``: exact cost of periodic control with the same measurements, actuator and rate.
3. ``tune`` with ``goal``, ``search`` and ``shares``: parameters and periods that meet a budget.
4. ``tradeoff`` and ``compare``. They compute the ``points`` of a grid, on several ``workers`` if asked.
5. ``record``: results as text, restored bit by bit.
"""
