"""Simulation speed of this machine: ``bench`` measures it, and ``commands`` defines the command ``taciturn bench``."""
