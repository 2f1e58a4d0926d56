"""Worlds of faults: all nodes of a loop in one process, on virtual clocks, with faults that a seed chooses.

``world`` runs one, ``faults`` has the faults as data, ``virtual`` the clocks and sockets, ``devices`` nodes in C, and
``invariants`` what must hold in every world. ``commands`` is the option ``--world`` of ``taciturn network``.
"""
