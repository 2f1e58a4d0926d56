"""Nodes that run a policy on packets: pure state machines, the packet format, and drivers for UDP.

A node is a state machine that uses no socket, no time and no thread. Its inputs are packets and, at the sensor, a
measurement. Its outputs are packets and, at the actuator, the plant input. Simulations, tests and real networks run the
same node, and a run in virtual time can be repeated bit for bit.

Read the modules in this order:

1. ``packet``, ``window`` and ``inbox`` encode packets as bytes with checksum and tag, protect against replay, and
   handle late, repeated, missing and forged packets. Every case is counted.
2. ``node`` contains one node, ``nodes`` all nodes of a policy as one pure function, and ``control`` the conversion to
   and from systems of python-control.
3. ``relay`` and ``plant`` contain emulated links and a simulated plant. ``clock`` estimates the phase of the steps in
   real time.
4. ``udp`` is the only module with sockets. ``serve`` and ``world`` contain the servers for nodes, the plant and links.
   ``service`` contains the address message, logging and signal handling of a process.
5. ``processes`` and ``namespaces`` run all nodes and links on one machine. Either relays or the kernel drop packets.
"""
