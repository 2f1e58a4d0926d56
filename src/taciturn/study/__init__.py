"""Studies of one problem: evaluation of its policy by analysis or simulation, and description without computing cost.

A study takes a ``Problem``, designs its policy, chooses the method with the least predicted work for the requested
error, and returns frozen data with a JSON document, tables and figures.

Read the modules in this order:

1. ``evaluate`` with ``measure`` (choice of the method), ``evaluation`` (its result), ``sentences`` (words for its
   numbers) and ``evaluation_figure``; ``baseline``: the same loop with every sample; ``further_loops``: other loops
   that it compares with its own; ``set_point_steps``: send rates around changes of set-points. ``describe``: before
   that.
2. ``periodic``: exact cost of periodic control with the same measurements, actuator and rate; ``timed_links``: that of
   a given controller whose links send at fixed steps.
3. ``recorded``: the cost of silence in the logs of nodes, and the path of the loop that sends every sample.
4. ``record``: results as text, restored bit by bit.
"""
