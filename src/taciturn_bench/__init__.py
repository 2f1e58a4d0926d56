"""The simulation speed of this machine: ``bench`` measures it, ``commands`` has the command ``bench``."""
