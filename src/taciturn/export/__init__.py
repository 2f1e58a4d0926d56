"""Exports the nodes of a policy as C99 sources for devices, and as co-simulation units (FMUs).

The exported code consists of generated data and a handwritten core (``core/``), which is the same for every policy. The
core implements packets, their checks, the step of a node, and the exchange of packets between all nodes in one process.
It allocates no memory. The self-check, the FMU and the emulated boards run the same files. They compare every decision
and every bit of the input with a recording of the loop's bit-exact build.

Read the modules in this order:

1. ``node`` prints the data and the program of one site as C. ``folder`` adds the core, a self-check and a README.
2. ``vector`` records a run of a loop, with which exported nodes are compared.
3. ``description`` and ``fmu`` write the XML files and the archive of a unit, for FMI 2.0 and 3.0.
4. ``sizes`` measures the size of nodes, compiled for a Cortex-M or for this machine.
"""
