"""Worlds of faults: tests in which a loop's nodes run in one process with virtual clocks, and a seed draws faults.

``world`` runs one, ``faults`` has the faults as data, ``virtual`` the clocks and sockets, ``devices`` nodes in C, and
``invariants`` what must hold in every world. ``commands`` is the option ``--world`` of ``taciturn network``.
"""
