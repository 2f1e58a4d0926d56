"""Linear-quadratic-Gaussian control: functions that compute gains, costs and covariances from given matrices.

This package solves the classical part of every design, and does not depend on policies.

The regulator minimises the average of x'Qx + u'Ru + 2x'Nu for x⁺ = A x + B u + w. Its gain u = L x comes from

    K = Q + A'KA − (A'KB + N) (R + B'KB)⁻¹ (B'KA + N'),   L = −(R + B'KB)⁻¹ (B'KA + N').

The Kalman filter is the dual problem. The cost of the loop that sends every sample is J_all = tr(KW) + tr(PΣ): the
regulator's share, and the share of the estimation error with covariance Σ.

Read the modules in this order:

1. ``riccati`` and ``kalman``: gains over infinite and finite horizons, and steady filters. ``equation`` solves their
   equations, with a proof of the error, in one of the arithmetics of ``enclosures``: balls of any precision, or doubles
   with bounds on their rounding. ``quadratic`` has the problems in doubles, and leaves out states whose cost-to-go is
   zero and inputs that cost nothing.
2. ``sampling`` and ``discrete``: exact sampling of a continuous problem, with the cost of noise between samples, and
   inputs that the outputs show one step later. ``followed``: the deviations from what disturbances and set-points need.
   ``loaded``: loads of the simulated plant.
3. ``periodic`` and ``prediction``: an input that is held for several steps, or computed from a predicted state.
4. ``lossy`` and ``critical_losses``: control over links that drop packets, and the critical loss probabilities.
   ``late_samples``: measurements that arrive late. ``registers``: states that hold earlier inputs and outputs.
   ``missing_samples``: the gain of a filter whose samples are sometimes missing.
5. ``queries``: schedules of measurements, by their value to the controller or by the variances of predicted outputs.
6. ``stored`` and ``gain``: proofs for the gains as programs hold them, and the H∞ norm of a loop. ``cache``: results of
   equal data, which are computed once.
"""
