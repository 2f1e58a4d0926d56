"""Complete studies: evaluate, tradeoff, tune, compare, sweep, certify, reproduce, share a channel, run a network.

A study takes a ``Problem``, designs its policy, chooses the method with the least predicted work for the requested
error, and returns frozen data with a JSON document, tables and figures.

Read the modules in this order:

1. ``evaluation`` (a result and its text) and ``evaluate`` with ``measure`` (choice of the method) and ``lower`` (lower
   bounds).
2. ``fair`` and ``clock``: exact cost of periodic control with the same measurements, actuator and rate.
3. ``tradeoff``; ``tune`` with ``search``, ``trials``, ``tuned``, ``budget`` and ``periods``; ``compare``.
4. ``cells``: evaluation of all cells of a grid. ``workers``: processes. ``store``: results on disk. ``record``: results
   as text, restored bit by bit. ``sweep``: the grid as a labelled array.
5. ``channel`` with ``kinds``, ``prices`` and ``schedulers``: many loops on one channel.
6. ``certify``, ``describe``, ``bench``, ``network``, ``export``; ``reproduce`` with one module for each chapter.
"""
