"""Translation of a whole policy (all nodes and the links between them) to a program with measurements as inputs."""

from __future__ import annotations

from collections.abc import Mapping

from taciturn._arrays import Array
from taciturn.model.network import Network
from taciturn.model.packets import told_by
from taciturn.model.policy import ENDS, Policy, Send
from taciturn.program.ir import Builder, Coefficient, Program
from taciturn.program.lower import TimeStep, encode_payloads
from taciturn.program.ops import Precision


def lower_policy(policy: Policy, network: Network) -> Program:
    """Return the program of one time step of all nodes of a policy, from the measurement to the plant's input.

    Inputs: ``y i``, ``uniform i``. Outputs: ``applied i``, clipped by the model's ``input_limit``, ``sent LINK`` and
    ``arrived LINK``.

    Args:
        policy: the policy.
        network: the links between its nodes.
    """
    tick = begin_time_step(policy, network, {}, {})
    losses = draw_losses(tick, policy, network)
    tick.signals["y"] = [tick.builder.input(f"y {i}") for i in range(policy.model.outputs)]
    for step in policy.steps:
        tick.take(step, losses)
    applied = tick.clipped(tick.signals["input"], policy.model.input_limit)
    outputs = {f"applied {i}": value for i, value in enumerate(applied)}
    outputs |= {f"sent {link}": tick.as_number(truth) for link, truth in tick.sent.items()}
    outputs |= {f"arrived {link}": tick.as_number(truth) for link, truth in tick.arrived.items()}
    return tick.finish({}, outputs)


def begin_time_step(
    policy: Policy,
    network: Network,
    sizes: Mapping[str, int],
    initial: Mapping[str, Array | str],
    precision: Precision = "float64",
) -> TimeStep:
    """Return a new time step of all nodes of a policy, before its first policy step is translated.

    ``sizes`` and ``initial`` add further signals.
    """
    bad = [is_bad(link) for link in ENDS]
    payloads = encode_payloads(policy, network)
    told = {link: {name: how[name] for name in told_by(policy, link)} for link, how in payloads.items()}
    sizes = {**policy.sizes, **sizes, **dict.fromkeys(bad, 1)}
    initial = {**policy.initial, **initial, **{name: name for name in bad}}
    return TimeStep(Builder(precision), sizes, initial, policy.locations, told)


def draw_losses(tick: TimeStep, policy: Policy, network: Network) -> dict[str, Coefficient]:
    """Return the loss probability of each link: a constant, or a value that depends on the state of a bursty link."""
    losses: dict[str, Coefficient] = {}
    for link in ENDS:
        burst, b = network.burst(link), tick.builder
        losses[link] = network.loss(link)
        if burst is not None and any(isinstance(s, Send) and s.link == link for s in policy.steps):
            # Gilbert–Elliott model: a memory in {0, 1} selects the loss, and changes with probability to_bad or to_good
            (bad,) = tick.read(is_bad(link))
            losses[link] = b.lookup([burst.loss_good, burst.loss_bad], bad)
            turn = b.value(b.lookup([burst.to_bad, burst.to_good], bad))
            turned = b.emit("sub", b.constant(1.0), bad)
            tick.signals[is_bad(link)] = [tick.choose(b.emit("greater", turn, tick.uniform()), turned, bad)]
    return losses


def is_bad(link: str) -> str:
    """Return the name of the memory that is 1 while a link with burst losses is in its bad state, and 0 otherwise."""
    return f"{link} link is bad"
