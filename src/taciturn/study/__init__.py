"""Studies of one problem: its policy is evaluated, or described without a simulation.

A study takes a ``Problem``, designs its policy, chooses the method with the least predicted work for the requested
error, and returns frozen data with a JSON document, tables and figures.

Read the modules in this order:

1. ``evaluate`` with ``measure`` (choice of the method), and ``evaluation`` (its result). ``describe``: before that.
2. ``periodic``: exact cost of periodic control with the same measurements, actuator and rate.
3. ``record``: results as text, restored bit by bit.
"""
