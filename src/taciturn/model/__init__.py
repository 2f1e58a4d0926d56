"""Plants, costs, networks, triggers and policies, as immutable data that are checked when they are constructed.

This package defines problems and policies. Other packages compute gains and simulate loops.

A policy is a switched linear map with a quadratic trigger. In every step

    z⁺ = F z + G w,   action = argmin_i (z'Ψ_i z + c_i),   stage cost z'M z,

where F, G and M depend on the action, on the packets that arrive, and on a finite discrete state such as a schedule.
A ``Policy`` writes this map as a list of policy steps, each at a node: ``Assign`` a signal, ``Evaluate`` a quadratic
form, ``Draw`` a random number, ``Apply`` a function, ``Decide`` for the smallest form, ``Send`` a packet. Two rules
define memory and delay. A signal that is read before it is assigned has its value of the previous step, so it is a
memory. A packet that is read before it is sent is the packet of the previous step, so it has a delay of one step.

Read the modules in this order:

1. ``plant``, ``dynamics``, ``cost``, ``controller``, ``network``, ``link``, ``losses``, ``delay``: the problem.
   ``transport``: constant delays of links as delays of the plant. ``signals``:
   disturbances and set-points, ``load``: loads; ``disturbance`` joins them to a plant. ``operating_point``,
   ``saturation``, ``limits``: the point from which a plant counts, limits of its inputs, and limits of its states that
   are watched. ``names``: of its states, inputs and outputs. ``noise``: W and V by the amplitudes of the noise at
   inputs and outputs.
   ``state_space``: plants from other libraries. ``key``: what a field states as a key of a problem file.
2. ``trigger``: quadratic forms, and tables that a discrete state selects.
3. ``steps``: the policy steps, and discrete states with their cycle.
4. ``theory`` and ``policy``: proven properties of a policy, such as its guarantee, and the policy itself with the
   limits of links on the intervals between sends. ``expected``: the measurements that its nodes predict.
   ``set_points``: how a policy limits its set-points. ``silence``: the
   cost of silence that running nodes measure.
   ``diagram``: its nodes and links, with the ``rule`` by which a link sends, in ``words``.
5. ``information`` and ``coverage``: the check that a node reads only available signals, and the properties that a
   theory or an interpreter carries out.
6. ``packets`` and ``wire``: the packets of a policy, its fingerprint, and the layout of a datagram.
7. ``schedule``, ``estimate``, ``result``: the results that users see.
"""
