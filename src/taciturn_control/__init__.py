"""Conversion to and from systems of python-control: ``systems`` has ``taciturn.to_control`` and ``from_control``."""
