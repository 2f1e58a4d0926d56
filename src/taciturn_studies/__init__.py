"""Studies that evaluate a problem many times: trade-offs, tuning, and comparisons of policies.

1. ``tradeoff``: cost against rate over a grid of parameters, with ``tradeoff_figure``.
2. ``tune``, with ``goal`` (budgets), ``search`` (one parameter) and ``shares`` (of several links).
   ``buffers``: the buffer of a receiver with the least cost.
3. ``compare``: several policies at the same rate or traffic, with ``periodic_links``, the exact cost of periodic
   control over several links.
4. ``points``: the evaluations of a grid, with a store of results. ``workers``: the processes and clusters that compute
   them.
5. ``commands``: the commands ``tradeoff``, ``compare`` and ``tune``.
"""
