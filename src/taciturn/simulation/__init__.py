"""Simulation of closed loops: averages with standard errors, runs over a finite horizon, and single trajectories.

All paths are independent, and the draws of a path depend only on the seed and the number of the path. So the standard
error is that of a mean over independent paths, for any correlation in time, and the result does not depend on the
number of threads or on vector instructions.

Read the modules in this order:

1. ``average``: the public functions, and the sum whose mean gives the cost. ``sampling``: simulation of paths: burn-in,
   windows, and the test that the initial transient has decayed.
2. ``statistics``: means, batch means and renewal cycles with standard errors.
3. ``reliability``: detection of averages that do not exist, or whose standard error cannot be trusted.
4. ``trajectory``: one path, and the mean cost at each step. ``same_packets``: periodic control to compare it with.
   ``late_packets``: how late the packets of links with random delays are. ``bank``: many loops side by side.
"""
