"""Design functions of all policies, one family of policies per file, with their guarantees on the cost.

A design function takes a plant, a cost and its parameters, and returns a ``Policy``, which is data rather than code.
The function solves the underlying LQG problem (``taciturn.lqg``), writes the policy steps, and states the theorem. The
certainty-equivalent designs share ``certainty``: with the error e of the actuator's input, completion of squares gives

    J = J_all + E[e'(R + B'KB)e in silence],

so every trigger that bounds this square bounds the cost (``bounds``). ``estimation`` writes the filters at sensor or
actuator, ``prediction`` the policies that predict in continuous time, and ``prices`` the costs that a schedule of
queries weighs. A kind is a file in ``kinds`` that ends with the record of the kind (``kind``); ``catalogue`` lists
these files and the kinds of other packages. A new kind requires a file in ``kinds`` and a test of its theorem.

The design functions are attributes of this package: ``design.lqg`` is the one of the kind ``lqg``. A kind is imported
when its function is used for the first time.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from taciturn.design.catalogue import CATALOGUE, own_kinds

if TYPE_CHECKING:  # for type checkers and editors; the functions are found by the catalogue
    from taciturn.design.kinds.absolute import absolute as absolute
    from taciturn.design.kinds.all_time import all_time as all_time
    from taciturn.design.kinds.consistent import consistent as consistent
    from taciturn.design.kinds.downsampled import downsampled as downsampled
    from taciturn.design.kinds.dynamic import dynamic as dynamic
    from taciturn.design.kinds.event_pid import event_pid as event_pid
    from taciturn.design.kinds.event_pid_saturated import event_pid_saturated as event_pid_saturated
    from taciturn.design.kinds.excess import excess as excess
    from taciturn.design.kinds.integral import integral as integral
    from taciturn.design.kinds.lossy_lqg import lossy_lqg as lossy_lqg
    from taciturn.design.kinds.lqg import lqg as lqg
    from taciturn.design.kinds.mixed import mixed as mixed
    from taciturn.design.kinds.near_optimal import near_optimal as near_optimal
    from taciturn.design.kinds.optimal import optimal as optimal
    from taciturn.design.kinds.periodic import periodic as periodic
    from taciturn.design.kinds.periodic_schedule import periodic_schedule as periodic_schedule
    from taciturn.design.kinds.relative import relative as relative
    from taciturn.design.kinds.remote_lqg import remote_lqg as remote_lqg
    from taciturn.design.kinds.rollout import rollout as rollout
    from taciturn.design.kinds.self_triggered import self_triggered as self_triggered
    from taciturn.design.kinds.send_on_delta import send_on_delta as send_on_delta
    from taciturn.design.kinds.stochastic import stochastic as stochastic
    from taciturn.design.kinds.symmetric_send_on_delta import symmetric_send_on_delta as symmetric_send_on_delta
    from taciturn.design.kinds.variance import variance as variance

__all__ = [name.replace("-", "_") for name in own_kinds()]  # pyright: ignore[reportUnsupportedDunderAll]


def __getattr__(name: str) -> object:
    kind = name.replace("_", "-")
    if name.startswith("_") or "-" in name or kind not in CATALOGUE:
        raise AttributeError(f"module 'taciturn.design' has no attribute {name!r}")
    globals()[name] = CATALOGUE[kind].design
    return globals()[name]


def __dir__() -> list[str]:
    return sorted({*globals(), *(kind.replace("-", "_") for kind in CATALOGUE)})
