"""Rates, costs and optimal schedules of estimation errors that each send resets to zero.

In many policies a single error decides whether to send, and a send replaces this error by fresh noise:

    e⁺ = F e + w while silent,   e⁺ = w after a send,   send if e'Ψe > c.

The sends then form a renewal process. The mean interval is τ = Σ_k P(no send for k checks), and the rate is 1/τ. The
excess, the cost beyond that of sending every sample, is the sum of E[e'Γe] over an interval, divided by τ. This package
computes these sums by quadrature or by conditional sampling, and finds the best trigger for the same error.

Read the modules in this order:

1. ``chain``: the data of the error, and the results of an analysis. ``_whiten`` removes directions of the error that no
   noise reaches or no weight depends on.
2. ``gaussian`` with ``_nodes``, ``_system`` and ``_check``: quadrature under Gaussian noise, up to three dimensions,
   with an error estimate; ``_intervals``: the distribution of the intervals.
3. ``paths`` with ``_randomisation`` and ``_quasi_monte_carlo``: conditional sampling in any dimension, weighted by the
   probability of no send.
4. ``jumps`` with ``_jump_line``, ``_jump_plane``, ``_jump_density`` and ``_jump_sums``: quadrature under Poisson jumps.
5. ``rates`` and ``_chi_square``: certified bounds on the rate.
6. ``optimal`` and ``_continuation``: the best schedule at a price per send, a stopping problem with a free boundary;
   ``fitted``: an approximation in any dimension; ``dual`` and ``_martingale``: a lower bound for every schedule.
7. ``events``, ``cycles``, ``sampled`` and ``bernstein``: triggers in continuous time, with exact event times.
8. ``allocation``: periodic control of the same error. ``rare_sends``: bounds for errors that hardly ever need a send.
"""
