"""Design functions of all policy kinds, with proven bounds on the cost. Each file contains one family of policies.

A design function takes a plant, a cost and its parameters, and returns a ``Policy``, which is data rather than code.
The function solves the underlying LQG problem (``taciturn.lqg``), writes the policy steps, and states the theorem. The
certainty-equivalent designs share ``taciturn.base``: with the error e of the actuator's input, completion of squares
gives

    J = J_all + E[e'(R + B'KB)e in silence],

so every trigger that bounds this square bounds the cost (``bounds``). ``silence`` is the rule for any base, and
``several_nodes`` that for several sensors and actuators. ``around_controller`` writes the links around any linear
controller, with the rule of ``dead_bands``, or with a bound on every path (``every_path``). ``prediction`` writes
policies that predict, and ``at_fixed_steps`` those without a decision. ``late`` decides on packets with random delays,
relative to the loops of ``late_base``, by packets in flight (``late_flight``) and probabilities (``late_belief``);
``late_sensor`` does so for measurements, and ``late_filter`` fuses those that are late at their own steps.
``missing_samples`` changes the gain of the filter of any kind. A kind is a file in ``kinds`` that ends with the record
of the kind (``kind``); ``catalogue`` lists these files and the kinds of other packages. A new kind requires a file in
``kinds`` and a test of its theorem.

The design functions are attributes of this package: ``design.lqg`` is the one of the kind ``lqg``. A kind is imported
when its function is used for the first time.
"""

from __future__ import annotations

from taciturn.design.catalogue import CATALOGUE, own_kinds

__all__ = [name.replace("-", "_") for name in own_kinds()]  # pyright: ignore[reportUnsupportedDunderAll]


def __getattr__(name: str) -> object:
    kind = name.replace("_", "-")
    if name.startswith("_") or "-" in name or kind not in CATALOGUE:
        raise AttributeError(f"module 'taciturn.design' has no attribute {name!r}")
    globals()[name] = CATALOGUE[kind].design
    return globals()[name]


def __dir__() -> list[str]:
    return sorted({*globals(), *(kind.replace("-", "_") for kind in CATALOGUE)})
