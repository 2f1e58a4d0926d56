"""The policy kind ``integral`` and its analysis: triggers in continuous time, for plants with Poisson jumps.

``integral`` is the kind. ``events`` computes the times between sends exactly, ``cycles`` their costs, and ``policy``
has the policy that is analysed without steps. ``jumps`` solves the renewal equations of checks under jumps by
quadrature, with the ``jump_density`` of summed jumps. ``losing_thresholds`` finds thresholds that
lose to periodic control.
"""
