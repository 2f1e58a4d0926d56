"""Straight-line programs that compute one time step of a loop, and their back ends: NumPy (reference), LLVM, Python, C.

A closed loop is a map from one time step to the next:

    z⁺ = f(z, w),   y = h(z, w)

with the memory z of all nodes and of the plant, the noise w, and recorded values y. A policy is data, a list of policy
steps (``Assign``, ``Decide``, ``Send``, …) with matrices. This package translates this list once into a program, a list
of scalar operations without branches and loops, such as

    v7 = state 0,  v8 = mul v3 v7,  v9 = add v8 v5,  v10 = greater v9 v2,  v11 = select v10 v9 v4

and every back end runs this list: simulation, nodes over UDP, and devices. Each operation rounds once, in the order of
the program. Therefore all back ends compute the same numbers and make the same decisions, bit for bit.

    policy steps, plant, network → lower → Program → numpy | llvm | python | c → next states, sums, outputs

A program reads the states of the previous time step, constants, and inputs (measurements, packets, or supplied noise).
The program computes the next states, sums over the steps (costs, numbers of packets), and outputs at each step.

Three simplifications keep programs short. Multiplications by zero and one are removed, equal operations are computed
once, and states that provably agree at every step are merged. For example, without losses the controller's copy of the
stored input and the stored input of the actuator become one state.

Random numbers and elementary functions are operations of the program as well. No back end calls a mathematical
library, because the last digits of such libraries differ between platforms.

Read the modules in this order:

1. ``ops`` and ``ir``: the operations, ``Program``, and ``Builder``, which simplifies and merges.
2. ``translation``: translates policy steps to operations. ``node`` (one site, with packets as inputs, in up to two
   parts per step) and ``all_nodes`` (all nodes and links of a policy) use it, ``late``, packets that arrive at random
   times, ``missing``, which replaces samples
   that are missing, ``gap``, which corrects a controller after them, and ``manual``, which replaces commands.
   ``taciturn.loop`` adds the plant.
3. ``numpy``: the reference implementation, one operation after the other over all paths.
4. ``llvm``: vectors with one lane per path, in loops over paths and steps. ``machine`` compiles, caches and runs on
   threads. ``engine`` chooses between LLVM and NumPy.
5. ``draws`` and ``single``: random numbers in double and single precision, and control variates. ``signals``: Poisson
   jumps within a step, and changes of set-points.
6. ``functions``: elementary functions with the names of NumPy's functions. ``tracing``: calls a NumPy function of a
   policy or plant once with symbols, and records its operations.
7. ``python`` and ``c``: source code for nodes and devices. ``quadratic``: programs as quadratic forms.
   ``ranges``: the ranges that values keep at every step.
"""
