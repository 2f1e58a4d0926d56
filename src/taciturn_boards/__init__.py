"""Exported nodes that run on emulated Cortex-M boards.

``cortex`` compiles nodes for a board, runs them in QEMU, and counts their instructions. ``processor`` runs a node on a
board that a host steps over the serial port.
"""
