"""Certificates of loops without simulation: decay, gain, cost and mean square, from matrix inequalities.

``certificates`` states the inequalities of a loop, ``inequalities`` solves them and verifies the solution, and
``certify`` has ``taciturn.certify``. ``commands`` has the command ``certify``.
"""
