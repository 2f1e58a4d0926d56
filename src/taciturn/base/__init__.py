"""The loop that sends every sample: its cost, the reference of all policies, and the cost that an omitted packet adds.

A base chooses c = K z in every step, with z⁺ = Φz + Γc + w and a quadratic stage cost. A policy that uses another value
c + e in silence costs E[e'He + 2e'(slope)z] more (``value``). For LQG, z is the estimate and the slope is zero.

Read the modules in this order:

1. ``value``: the value of any base, also over links that drop packets, and the cost of silence.
2. ``filter``: the estimate of the state as policy steps, and the step counter of all that changes with the step.
3. ``route``: the policy steps of the link over which a base sends, and the base of a given controller on each link.
4. ``certainty``: LQG as a base. ``gains``: its gains for a horizon, a discount, or links that drop packets.
5. ``given_controller``: the loop of a controller of the user, with its slow disturbance and its set-point.
6. ``response``: the response of such a loop to its own silence, whatever the noise is.
7. ``nominal``: a policy with what its base fixes. ``anti_windup``: a policy for inputs with limits, and
   ``limited_value``: the cost of silence for these.
8. ``periods``: a period in which inputs change because packets arrive. ``late``: the value of a base whose packets
   arrive late, by any random delay, and the cost of silence there.
"""
