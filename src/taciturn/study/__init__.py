"""Complete studies: evaluate, tradeoff, tune, compare, sweep, certify, share a channel, run a network.

A study takes a ``Problem``, designs its policy, chooses the method with the least predicted work for the requested
error, and returns frozen data with a JSON document, tables and figures.

Read the modules in this order:

1. ``evaluation`` (a result and its text) and ``evaluate`` with ``measure`` (choice of the method) and ``lower`` (lower
   bounds).
2. ``fair`` and ``clock``: exact cost of periodic control with the same measurements, actuator and rate.
3. ``tuning``: parameters and periods that meet a budget. ``sweeping``: grids of problems.
4. ``tradeoff`` and ``compare``, which use both. ``record``: results as text, restored bit by bit.
5. ``channel``: many loops on one channel. ``testbed``: nodes that run, over UDP or under faults.
6. ``certify``, ``describe``, ``bench``, ``export``.
"""
