"""Nodes that run a policy by exchanging packets: pure state machines, the packet format, and secret keys.

A node is a state machine that uses no socket, no time and no thread. Its inputs are packets and, at the sensor, a
measurement. Its outputs are packets and, at the actuator, the plant input. Simulations, tests and real networks run the
same node, and a run in virtual time can be repeated bit for bit.

Read the modules in this order:

1. ``packet`` encodes packets as bytes with checksum and tag, with the secrets of ``keys``. ``inbox`` protects against
   replay, and handles late, repeated, missing and forged packets. Every case is counted.
2. ``node`` contains one node, ``together`` all nodes of a policy as one pure function, and ``description`` packets and
   nodes as JSON for programs in other languages.
3. ``simulated_plant`` contains a simulated plant. ``clock`` estimates the phase of the steps in real time, and
   ``lateness`` counts late packets by the steps that they are late.
"""
