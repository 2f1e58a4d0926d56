"""Send rates and costs of estimation errors that each send resets to zero, computed without simulation.

In many policies a single error decides whether to send, and a send replaces this error by fresh noise:

    e⁺ = F e + w while silent,   e⁺ = w after a send,   send if e'Ψe > c.

The sends then form a renewal process. The mean interval is τ = Σ_k P(no send for k checks), and the rate is 1/τ. The
excess, the cost beyond that of sending every sample, is the sum of E[e'Γe] over an interval, divided by τ. This package
computes these sums by quadrature or by conditional sampling.

Read the modules in this order:

1. ``chain``: the data of the error, and the results of an analysis. Directions of the error that no noise reaches or no
   weight depends on are removed.
2. ``gaussian`` on ``quadrature``: renewal equations under Gaussian noise, up to three dimensions, with an error
   estimate and the distribution of the intervals.
3. ``paths``: conditional sampling in any dimension, weighted by the probability of no send.
4. ``rates``: certified bounds on the rate.
5. ``without_steps``: policies that can be analysed but that no node can run.

Other packages add quadratures under jumps, triggers in continuous time, the best schedule, and bounds.
"""
