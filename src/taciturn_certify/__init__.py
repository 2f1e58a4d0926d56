"""Certificates of a loop from matrix inequalities, without simulation: decay rate, l2 gain, cost and mean-square state.

``certificates`` states the inequalities of a loop, ``inequalities`` solves them and verifies the solution, and
``certify`` has ``taciturn.certify``. ``commands`` has the command ``certify``.
"""
