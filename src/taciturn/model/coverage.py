"""The properties of plants, costs, networks and policy steps that theories, and programs that run policies, support.

A theorem holds for the plants, networks and policies of its assumptions, and a back end or a format carries out only
some steps. A new property of the model, such as a limit of inputs, must not be ignored silently by any of them. So each
states what it covers, and everything else that is given is refused.

The properties are the fields of the classes in ``taciturn.model``, such as ``plant.function`` or ``Assign.on``, and
the classes themselves, such as ``Draw``. A property is *given* if it differs from its neutral value: the default of the
field, or zero, ``None`` or nothing. ``uncovered`` walks through plants, policies and networks, field by field, and
returns the names of the properties that are given but not covered. For each class and each coverage, the fields whose
values need a comparison are found once (``_look``).

A ``Coverage`` lists the names of properties that an interpreter carries out. Names are listed one by one and are never
derived from the classes, so that a new field or a new class of policy steps is not covered until somebody adds its
name. A new property gets a group of names of its own, which each theory and each interpreter adds to its coverage when
it has learnt it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from collections.abc import Set as AbstractSet
from dataclasses import MISSING, Field, dataclass, fields, is_dataclass
from functools import lru_cache
from typing import Any, cast

import numpy as np
import numpy.typing as npt

from taciturn._display import Displayed
from taciturn.errors import ProblemError
from taciturn.model.link import LinkLaw
from taciturn.model.losses import LossLaw

MODEL = "taciturn.model."
_PREFIXES = {"Plant": "plant", "ContinuousPlant": "plant"}
_OWN = ("Cost", "Network", "Jumps", "Reference", "Tracking", "Controller", "Disturbance", "Exosystem")
_PREFIXES |= {name: name.lower() for name in _OWN} | {
    "NodeRole": "nodes",
    "LinkLaw": "links",
    "OperatingPoint": "operating_point",
}
_NEUTRAL: Mapping[str, object] = {"cost.discount": 1.0}  # neutral values other than the default of a field, or zero
_ABSENT = {"Trigger.limit", "Received.of_age"}  # fields whose zero is not neutral
_OPAQUE = ("plant.function", "Apply.function", "plant.names")  # callables, and names, which change no number
_NAMED = {  # the words of the message in place of a name and the usual remedy
    "plant.transport": ("a delay or a buffer of a link", "links without delay and buffer"),
    "links.delay": (
        "a delay that varies on a link without a buffer",
        "a constant delay, or a buffer, which uses each packet the same time after it was sent",
    ),
}
_LEAVES = frozenset({str, int, float, bool, np.ndarray, type(None)})  # most of what is found
_PLAIN = (str, int, float, np.ndarray, type(None), LossLaw)  # every law of losses has the same two properties


def names(owner: str, properties: str) -> frozenset[str]:
    """Return the names of a class and of its properties, such as ``cost``, ``cost.Q`` and ``cost.R``."""
    return frozenset({owner, *(f"{owner}.{name}" for name in properties.split())})


# states and inputs are deviations from an operating point, so all that holds for a plant around 0 holds there
POINT = names("operating_point", "x u") | {"plant.operating_point"}
# names change no number; stated_limit is input_limit in the units of the plant, so input_limit alone tells whether the
# inputs are limited
LINEAR_PLANT = names("plant", "A B C W V dt mean covariance full_state stated_limit names") | POINT
# a constant delay is a property of the plant, with registers as its states; any other one is a law of the link
REGISTERS = names("Transport", "inputs outputs certain") | {
    f"plant.{name}" for name in ("D", "registers", "transport", "stored")
}
ALONE = frozenset({"plant.alone"})  # the plant without the states that were added to it, whose properties are looked at
DRIFT = frozenset({"plant.drift"})
FUNCTION, LIMIT = frozenset({"plant.function"}), frozenset({"plant.input_limit", "plant.input_rate"})
JUMPS = names("jumps", "rate covariance distribution") | {"plant.jumps"}
EXOSYSTEM = names("exosystem", "S E G W start outputs F changes D") | {"plant.exosystem"}
CHANGES = (
    names("RandomSteps", "rate covariance")
    | names("Timetable", "times values")
    | (names("SampledChanges", "table") | {"plant.changes"})
)
LOADS = names("Load", "times values E G signal given") | {"plant.loads"}
# of set-points, which a controller enforces; the classes of set-points are those of CHANGES
SET_POINT_LIMITS = names("Saturation", "low high rate") | {
    f"{one}.limits" for one in ("RandomSteps", "Timetable", "SampledChanges")
}
WEIGHTS = names("cost", "Q R N")
ENDING = frozenset({"cost.horizon", "cost.terminal", "cost.discount"})
# a range has an effect only with a payload; prices and energies affect no packet
LINKS = names("network", "links delay stated") | names("links", "acknowledged range price energy battery")
GRAPH = names("nodes", "measures applies controls site") | {"network.nodes"}
LOSSES = frozenset({"links.loss"})
BURSTS = frozenset({"links.burst"})
ROUNDING = frozenset({"links.payload"})
SAMPLES = frozenset({"network.missing"})
CONTROLLER = names("controller", "A B C D E F G dt disturbance setpoint start_input") | (
    names("disturbance", "time_constant deviation")
)
TRACKING = names("tracking", "state input final") | names("reference", "states inputs")
LINEAR_STEPS = (
    names("Assign", "at signal branches on")
    | names("Decide", "at decision trigger")
    | names("Send", "at link payload on labels")
    | names("Received", "link")
    | names("Acknowledged", "link")
    | names("Trigger", "options")
    | names("Form", "signals Psi constant")
    | names("Scheduled", "by values")
    | names("Location", "name table at on initial")
)
MEMORIES = names("Evaluate", "at signal forms on") | {"Form.plus"}
BELLS = names("GaussianTerm", "height Pi") | {"Form.bell"}
DRAWS = names("Draw", "at signal")
FIRST = frozenset({"Trigger.limit"})
FUNCTIONS = names("Apply", "at signals function reads")
# random delays of packets, of which a sender with acknowledgements learns the time of arrival, and a receiver the age
LATE = names("DelayLaw", "waits odds in_seconds sequence block") | names("Acted", "link age piece")
LATE |= {"links.delay", "links.acknowledgement_delay", "Received.oldest", "Received.of_age"}
INTERVALS = frozenset({"links.min_interval", "links.max_interval", "Trigger.excluded"})

LINEAR_LOOP = LINEAR_PLANT | REGISTERS | ALONE | EXOSYSTEM | CHANGES | WEIGHTS | LINKS | GRAPH | LINEAR_STEPS
STEPS = LINEAR_STEPS | MEMORIES | BELLS | DRAWS | FIRST | FUNCTIONS
PLANTS = (
    LINEAR_PLANT | REGISTERS | ALONE | EXOSYSTEM | CHANGES | SET_POINT_LIMITS | LOADS | FUNCTION | LIMIT | JUMPS | DRIFT
)
NETWORKS = LINKS | GRAPH | LOSSES | BURSTS | ROUNDING | SAMPLES
LOOPS = PLANTS | WEIGHTS | ENDING | NETWORKS | TRACKING | CONTROLLER | STEPS | INTERVALS
# a theory of a linear loop with Gaussian noise; a theory with a claim refuses functions (Apply) by itself
GAUSSIAN_THEORY = LINEAR_LOOP | ENDING | LOSSES | TRACKING | STEPS
THEORY = GAUSSIAN_THEORY | JUMPS  # of a linear loop with any white noise


@dataclass(frozen=True, repr=False)
class Coverage(Displayed):
    """The properties of a model that a part of Taciturn, such as the simulation or an exporter, supports."""

    names: AbstractSet[str]  # the names of these properties
    refusal: str  # the interpreter and its limit, as the message states them: "certificates do not support"
    remedy: str = "a loop without this property"  # the expected loop, as the message states it

    def check(self, *things: object) -> None:
        """Raise an error if one of the given objects has a property that is not supported."""
        for name in uncovered(self.names, *things):
            raise ProblemError(self.sentence(name))

    def sentence(self, name: str) -> str:
        """Write the error message for a property that is not supported."""
        given, remedy = _NAMED.get(name, (name, self.remedy))
        return f"{given} is given, which {self.refusal}; expected {remedy}"


SIMULATED = Coverage(LOOPS | LATE, "designs and simulations do not model")


def uncovered(covered: AbstractSet[str], *things: object) -> list[str]:
    """Return the names of the properties that the given objects have but that are not in ``covered``."""
    found, known = dict[str, None](), frozenset(covered)
    for thing in things:
        _collect(known, thing, found)
    return list(found)


def _collect(covered: frozenset[str], thing: object, found: dict[str, None]) -> None:
    """Add the names of the properties that are given but not covered."""
    if isinstance(thing, LinkLaw):  # a plant shows its constant delay, and is looked at too
        thing = thing.played()
    kind = type(thing)
    looked = _look(kind, covered)
    if looked is None:
        held = cast("Mapping[Any, object] | Sequence[object]", thing)
        for one in held.values() if isinstance(held, Mapping) else held:
            if type(one) not in _LEAVES:
                _collect(covered, one, found)
        return
    usual, more, parts = looked
    for name in more:
        found[name] = None
    if usual is not None:
        own = [f"{_described(kind)[0]}.{name}" for name in vars(thing) if name not in usual and not hasattr(kind, name)]
        found.update((name, None) for name in own if name not in covered)
    for field, name in parts:
        value: object = getattr(thing, field.name)
        if name is not None:
            if not _is_neutral(name, field, value):
                found[name] = None
        elif type(value) not in _LEAVES:
            _collect(covered, value, found)


@lru_cache(maxsize=1024)
def _look(
    kind: type[object], covered: frozenset[str]
) -> tuple[frozenset[str] | None, tuple[str, ...], tuple[tuple[Field[Any], str | None], ...]] | None:
    """Return the fields of a class whose values need a check, or None for a collection."""
    # That is: the names of its fields (None if attributes are not looked at), the names that are not covered whatever a
    # thing contains, and the fields in order, each with its name if it is not covered.
    if issubclass(kind, (Mapping, tuple, list)):
        return None
    if issubclass(kind, _PLAIN):
        return None, (), ()
    owner, listed, overridden = _described(kind)
    if owner not in covered:
        return None, (owner,), ()
    more = tuple(name for name in overridden if name not in covered and name not in listed)
    parts = tuple(
        (field, None if name in covered else name)
        for name, field in listed.items()
        if name not in covered or name not in _OPAQUE
    )
    return frozenset(field.name for field in listed.values()), more, parts


@lru_cache(maxsize=256)
def _described(kind: type[object]) -> tuple[str, Mapping[str, Field[Any]], tuple[str, ...]]:
    """Return the name of a class in coverages, its fields by name, and the fields that a derived class overrides."""
    base = next((one for one in kind.__mro__ if one.__module__.startswith(MODEL)), None)
    if base is None or not is_dataclass(kind):
        return kind.__name__, {}, ()
    owner = _PREFIXES.get(base.__name__, base.__name__)
    derived = kind.__mro__[: kind.__mro__.index(base)]
    more = dict.fromkeys(f"{owner}.{name}" for one in derived for name in vars(one) if not name.startswith("__"))
    return owner, {f"{owner}.{one.name}": one for one in fields(kind)}, tuple(more)


def _is_neutral(name: str, field: Field[Any], value: object) -> bool:
    default = field.default_factory() if field.default_factory is not MISSING else field.default
    neutral: object = _NEUTRAL.get(name, None if default is MISSING else default)
    if isinstance(value, np.ndarray):
        array = cast("npt.NDArray[Any]", value)
        return not array.any() if neutral is None else np.array_equal(array, cast("Any", neutral))
    if name in _ABSENT:
        return value is None
    return bool(value == neutral or (neutral is None and not value))
