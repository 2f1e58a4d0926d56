"""The packets that the nodes of a policy exchange, and the fingerprint that identifies a policy."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Mapping
from dataclasses import fields, is_dataclass
from typing import Any, cast

import numpy as np

from taciturn._arrays import Array
from taciturn.errors import ProblemError
from taciturn.model.network import Network
from taciturn.model.places import plant_links
from taciturn.model.policy import ONE, Apply, Policy, Send
from taciturn.model.steps import assigned
from taciturn.model.wire import PERSON, Encoding, PacketKind

POINTS = 3  # number of points at which a function is evaluated for the fingerprint
LATER: Mapping[str, object] = {
    "Trigger.limit": None,
    "Trigger.excluded": {},
}  # fields of later versions, which fingerprints omit if so
DIGITS = 1e6  # resolution relative to the largest entry of a matrix, to which designs on different machines agree


def packet_shapes(policy: Policy, network: Network) -> dict[tuple[PacketKind, str], tuple[Encoding, int]]:
    """Return the encoding and the number of entries of the payload of each packet, by kind and link.

    Raises:
        ProblemError: if payloads are rounded and a range is missing.
    """
    exact, shapes = Encoding(), dict[tuple[PacketKind, str], tuple[Encoding, int]]()
    for step in policy.steps:
        if isinstance(step, Send):
            entries = sum(policy.sizes[name] for name in step.payload)
            (whole,) = network.encoding(step.link).parts([entries])
            shapes |= {
                ("data", step.link): (whole, entries),
                ("acknowledgement", step.link): (exact, 0),
                ("mark", step.link): (exact, 0),
            }
    for link, ends in plant_links(policy).items():
        sizes: dict[PacketKind, int] = {"measurement": len(ends.outputs), "input": len(ends.inputs)}
        shapes |= {(kind, link): (exact, size) for kind, size in sizes.items() if size}
        shapes |= {("mark", link): (exact, 0)}
    return shapes


def told_by(policy: Policy, link: str) -> tuple[str, ...]:
    """Return the signals in the packets of a link that are not otherwise available to the receiver."""
    receiver = policy.network.receiver(link)
    homes = {name: step.at for step in policy.steps for name in assigned(step)} | {ONE: receiver}
    homes |= {signal: node for signal, (node, _) in policy.measured.items()}
    names = [name for step in policy.steps if isinstance(step, Send) and step.link == link for name in step.payload]
    return tuple(name for name in dict.fromkeys(names) if homes[name] not in policy.site(receiver))


def fingerprint(policy: Policy, network: Network) -> int:
    """Return a 64-bit fingerprint of a policy's steps, locations and initial values, with six digits of each matrix.

    Two machines whose linear algebra rounds differently compute the same fingerprint. A function is identified by its
    values at a few points, not by its source code.
    """
    policy = policy.in_units
    steps = [_sampled(policy, step) if isinstance(step, Apply) else step for step in policy.steps]
    data = (steps, policy.locations, dict(policy.initial), policy.sites, policy.tick, network.protocol)
    data = data if network.triangle else (*data, network.nodes)
    rounding = [network.encoding(step.link) for step in policy.steps if isinstance(step, Send)]
    limit, rate = policy.model.input_limit, policy.model.input_rate
    limits = [None if limit is None else _sides(limit), *([] if rate is None else [_sides(rate)])]
    text = repr(_plain([data, rounding, *limits]))
    return int.from_bytes(hashlib.blake2s(text.encode(), digest_size=8, person=PERSON).digest(), "big")


def _sides(limit: Array) -> object:
    """Return limits as one number per input if all are symmetric, and open sides apart."""
    closed = np.isfinite(limit)
    if not closed.all():
        return np.where(closed, limit, 0.0), closed.astype(np.float64)
    return limit[:, 1] if limit.ndim == 2 and np.array_equal(limit[:, 0], -limit[:, 1]) else limit


def _sampled(policy: Policy, step: Apply) -> object:
    """Return an ``Apply`` step in which the function is replaced by its values at three points."""
    found: list[object] = []
    sizes = [policy.sizes[name] for name in step.reads]
    for point in range(1, 1 + POINTS):
        values = np.modf(np.sqrt(point + 7.0 * np.arange(sum(sizes))))[0]  # spread over [0, 1)
        try:
            with np.errstate(all="ignore"):
                returned = step.function(*np.split(values, np.cumsum(sizes)[:-1]))
        except Exception as error:
            raise ProblemError(
                f"the function of {', '.join(step.signals)} fails: {type(error).__name__}: {error}; expected a "
                f"function of the vectors {', '.join(step.reads)}"
            ) from error
        listed = cast("Iterable[Any]", (returned,) if len(step.signals) == 1 else returned)
        found += [np.nan_to_num(np.asarray(one, dtype=np.float64)) for one in listed]
    return ("Apply", step.at, dict(step.signals), step.reads, found)


def _plain(value: object) -> object:
    """Return data as nested tuples of strings and integers."""
    if is_dataclass(value) and not isinstance(value, type):
        named = {f"{type(value).__name__}.{field.name}": getattr(value, field.name) for field in fields(value)}
        held = [_plain(one) for name, one in named.items() if name not in LATER or one != LATER[name]]
        return (type(value).__name__, *held)
    if isinstance(value, np.ndarray | float):
        return _whole(np.asarray(value, dtype=np.float64))
    if isinstance(value, Mapping):
        return tuple((str(key), _plain(one)) for key, one in cast("Mapping[object, object]", value).items())
    if isinstance(value, frozenset):
        return tuple(sorted(cast("frozenset[str]", value)))
    if isinstance(value, list | tuple):
        return tuple(_plain(one) for one in cast("Iterable[object]", value))
    return value


def _whole(values: np.ndarray[Any, Any]) -> object:
    """Return numbers as integers: the largest magnitude, and each number relative to the largest magnitude."""
    largest = float(np.abs(values).max(initial=0.0))
    if largest == 0.0:
        return (values.shape, 0)
    return (values.shape, f"{largest:.5e}", *np.rint(values / largest * DIGITS).astype(np.int64).ravel().tolist())
