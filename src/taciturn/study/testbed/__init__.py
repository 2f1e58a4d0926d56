"""Nodes that run: as processes over UDP, or in one process with faults.

``network`` runs the nodes of a problem as processes, reads their ``logs``, and measures the cost of the recorded steps
(``ticks``). ``worlds`` runs them under faults that a seed chooses: one ``world``, the keys of its nodes (``keyring``),
nodes in C (``devices``), and what must hold (``invariants``).
"""
