"""Optimal send schedule of a controller for a price per send, and lower bounds on the cost of all schedules.

``optimal`` solves the stopping problem by quadrature, and ``optimal_kind`` is the kind ``optimal``. ``fitted``
approximates it by a quadratic and a bell, and ``near_optimal_kind`` is the kind ``near-optimal``. ``dual`` bounds the
cost of every schedule from below, and ``bounds`` converts this bound to the units of a loop.
"""
