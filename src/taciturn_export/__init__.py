"""Nodes exported as C99 sources, as libraries for boards, and as co-simulation units (FMU).

``node`` prints a node of a policy as C, ``folder`` all nodes with a self-check, ``library`` the files that PlatformIO,
Arduino and Zephyr need, and ``fmu`` a co-simulation unit. ``sizes`` counts bytes. ``export`` has the functions
``taciturn.export_c`` and ``taciturn.export_fmu``, ``commands`` the command ``export``. ``core`` is handwritten C, and
``fmi`` the headers of the FMI standard.
"""
