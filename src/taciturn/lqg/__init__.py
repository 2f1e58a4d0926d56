"""Linear-quadratic-Gaussian control: matrices in, matrices out.

``riccati`` makes gains, ``kalman`` filters, ``sampling`` turns a continuous problem into a discrete one,
``periodic`` prices an input that is held for several steps.
"""
