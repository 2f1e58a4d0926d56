"""Conversion to systems of python-control and back, by ``taciturn.to_control`` and ``taciturn.from_control``."""
