"""A policy that decides on one actuator link, on a network with several of them: the controller decides on sets.

In silence on some links, the inputs of these links differ from the command by their part of the error. The cost of this
silence is the form of the policy with the other entries of the error replaced by zero. Two rules choose the set of
links that send:

- If silence costs nothing without an error, its cost is compared with a price δ of a packet on every link, of which a
  set has the share of its packets' prices. The set with the least sum of cost and price sends.
- Otherwise, the cheapest set sends whose silence costs at most δ.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import chain, combinations

import numpy as np

from taciturn._arrays import Array
from taciturn._display import Displayed
from taciturn.errors import PlacementError, ProblemError
from taciturn.model.network import Network
from taciturn.model.policy import Assign, Decide, Evaluate, Policy, Received, Send, Step
from taciturn.model.steps import read
from taciturn.model.theory import Theory
from taciturn.model.trigger import Form, Scheduled, Trigger

MOST_LINKS = 4  # whose sets are compared
ERROR, CANDIDATE, COMMAND, INPUT = "error", "candidate", "command", "input"


@dataclass(frozen=True, eq=False, repr=False)
class JointSets(Displayed):
    """The sets of links of a network, and the steps of a policy for each set.

    Args:
        policy: a policy of a sensor, a controller and an actuator.
        network: the nodes and links. The steps may have the names of its nodes, the actuator that of any of them.
    """

    policy: Policy
    network: Network

    @cached_property
    def actuators(self) -> Mapping[str, tuple[str, list[int]]]:
        """The signal and the indices of the inputs that an actuator applies, by node."""
        found = self.network.applications(self.policy.model.inputs)
        return {node: (signal, [*rows]) for signal, (node, rows) in found.items()}

    @cached_property
    def links(self) -> tuple[str, ...]:
        """The actuators with a link."""
        return tuple(node for node in self.actuators if node in self.network.links)

    @cached_property
    def weights(self) -> Mapping[str, float]:
        """The share of each link in the price of a packet on every link."""
        prices = {link: self.network.links[link].price for link in self.links}
        return {link: price / sum(prices.values()) for link, price in prices.items()}

    @cached_property
    def all(self) -> tuple[tuple[str, ...], ...]:
        """The sets of links that send, the cheapest first."""
        sets = chain.from_iterable(combinations(self.links, size) for size in range(len(self.links) + 1))
        return tuple(sorted(sets, key=lambda sent: sum(self.weights[link] for link in sent)))

    @cached_property
    def decision(self) -> str:
        """The name of the decision on the actuator link; empty if there is none with two options."""
        on = [step.on for step in self.policy.steps if isinstance(step, Send)]
        made = [step for step in self.policy.steps if isinstance(step, Decide) and [step.decision] == on]
        return made[0].decision if len(made) == 1 and len(made[0].trigger.options) == 2 else ""

    @cached_property
    def partial(self) -> frozenset[str]:
        """The signals whose value depends on the set: error and candidate, and forms of them."""
        found = {ERROR, CANDIDATE}
        for step in self.policy.steps:
            if isinstance(step, Evaluate) and any(found.intersection(form.reads) for form in step.forms):
                found.add(step.signal)
        return frozenset(found)

    @cached_property
    def greedy(self) -> bool:
        """True if silence costs nothing without an error."""
        silent = next(
            next(iter(step.trigger.options.values()))
            for step in self.policy.steps
            if isinstance(step, Decide) and step.decision == self.decision
        )
        first = {step.signal: step.forms[0] for step in self.policy.steps if isinstance(step, Evaluate)}
        forms = [silent, *(first[name] for name in silent.plus if name in first)]
        return all(self._vanishes(form) for form in forms)

    def _vanishes(self, form: Form) -> bool:
        sizes = [self.policy.sizes[name] for name in form.signals]
        rest = np.repeat([name != ERROR for name in form.signals], sizes)
        values = form.Psi.values if isinstance(form.Psi, Scheduled) else form.Psi
        constant = form.constant.values if isinstance(form.constant, Scheduled) else form.constant
        weighed = values is not None and values[..., rest, :][..., rest].any()
        return not weighed and not np.any(constant) and form.bell is None and self.partial.issuperset(form.plus)

    def check(self) -> None:
        """Raise an error if the controller cannot decide on sets of actuator links.

        Raises:
            PlacementError: a packet carries more than the input, the identity refers to periodic packets, or there are
                too many links.
        """
        kind, listed = self.policy.kind, ", ".join(self.links)
        sends = [step for step in self.policy.steps if isinstance(step, Send)]
        if len(self.links) > MOST_LINKS:
            raise PlacementError(
                f"{kind} decides on the {2 ** len(self.links)} sets of {len(self.links)} actuator links; expected at "
                f"most {MOST_LINKS} links"
            )
        if any(step.payload != (COMMAND,) for step in sends):
            raise PlacementError(
                f"the packets of {kind} carry more than the input, and several links ({listed}) decide; expected "
                "actuators that hold their input (actuation = 'hold')"
            )
        if len(sends) != 1 or not self.decision:
            raise PlacementError(
                f"{kind} has no single decision on its actuator link, and several links ({listed}) decide; expected "
                "one actuator link"
            )
        identity = self.policy.theory.identity
        if identity is not None and len(identity.forms) > 1 and _weighs(identity.forms[1]):
            raise PlacementError(
                f"the base of {kind} sends at some steps only, and several links ({listed}) decide; expected "
                "every = 1, or one actuator link"
            )

    def whole(self, sent: Sequence[str]) -> bool:
        """Return whether a set contains all links."""
        return len(sent) == len(self.links)

    def label(self, sent: Sequence[str]) -> str:
        """Return the label of a set."""
        return " and ".join(sent) or "silent"

    def named(self, signal: str, sent: Sequence[str]) -> str:
        """Return the name of a signal if a set sends; the value without any packet keeps its name."""
        differs = signal in self.partial and (sent or len(self.links) < len(self.actuators))
        return f"{signal} if {self.label(sent)}" if differs else signal

    def form(self, form: Form, sent: Sequence[str]) -> Form:
        """Return the form of the error that remains if a set sends."""
        signals = tuple(self.named(name, sent) for name in form.signals)
        plus = {self.named(name, sent): weight for name, weight in form.plus.items()}
        return Form(signals, form.Psi, form.constant, plus, form.bell)

    def silent(self, sent: Sequence[str]) -> Array:
        """Return the matrix that selects the inputs of silent links, (m, m)."""
        found = np.zeros(self.policy.model.inputs)
        for link in self.links:
            found[self.actuators[link][1]] = link not in sent
        return np.diag(found)

    def of(self, step: Step) -> tuple[Step, ...]:
        """Return the steps that replace a step of the policy."""
        if isinstance(step, Decide) and step.decision == self.decision:
            return (replace(step, trigger=self._trigger(step.trigger)),)
        if isinstance(step, Send):
            return tuple(found for node in self.actuators for found in self._send(step, node))
        if isinstance(step, Evaluate) and step.signal in self.partial:
            others = [sent for sent in self.all if not self.whole(sent)]
            return tuple(
                Evaluate(
                    step.at, self.named(step.signal, sent), tuple(self.form(one, sent) for one in step.forms), step.on
                )
                for sent in others
            )
        if not isinstance(step, Assign):
            return (step,)
        if step.signal == INPUT:
            return tuple(self._receive(step, node) for node in self.actuators)
        if step.on == self.decision:
            return (self._copied(step),)
        return (step, *self._errors(step)) if step.signal == ERROR else (step,)

    def theory(self, theory: Theory) -> Theory:
        """Return the theory of the policy that decides on sets of links."""
        identity, guarantee = theory.identity, theory.guarantee
        if identity is not None and identity.on is not None:
            forms = [Form() if self.whole(sent) else self.form(identity.forms[0], sent) for sent in self.all]
            identity = replace(identity, forms=tuple(forms))
        if guarantee is not None and guarantee.base is not None:
            statement = f"{guarantee.statement}; rate: Σ π_l r_l / Σ π_l with the price π_l of a packet on link l"
            guarantee = replace(guarantee, statement=statement, weights=self.weights)
        return replace(theory, identity=identity, guarantee=guarantee, reset=None, periodic=None)

    def _trigger(self, trigger: Trigger) -> Trigger:
        silent, price = trigger.options.values()
        options = {self.label(sent): self.form(silent, sent) for sent in self.all if not self.whole(sent)}
        last = self.label(self.all[-1])
        limit = price.constant
        if not self.greedy:
            if isinstance(limit, Scheduled):
                raise ProblemError(f"{self.policy.kind} decides by the {limit.by}; expected one actuator link")
            return Trigger({**options, last: Form()}, limit)
        for sent in self.all[1:-1]:
            share = sum(self.weights[link] for link in sent)
            part = Scheduled(limit.by, share * limit.values) if isinstance(limit, Scheduled) else share * limit
            form = options[self.label(sent)]
            added = part if isinstance(part, Scheduled) else part + _number(form.constant)
            options[self.label(sent)] = Form(form.signals, form.Psi, added, form.plus, form.bell)
        return Trigger({**options, last: price})

    def _errors(self, step: Assign) -> tuple[Step, ...]:
        """Return the error and the input of the plant for each set that leaves some links silent."""
        found = list[Step]()
        unit = np.eye(step.size)
        for sent in (one for one in self.all[:-1] if self.named(ERROR, one) != ERROR):
            silent = self.silent(sent)
            found.append(Assign(step.at, self.named(ERROR, sent), {ERROR: silent}))
            if any(CANDIDATE in read(other) for other in self.policy.steps if isinstance(other, Decide)):
                terms = {CANDIDATE: unit, ERROR: silent - unit}
                found.append(Assign(step.at, self.named(CANDIDATE, sent), terms))
        return tuple(found)

    def _send(self, step: Send, node: str) -> tuple[Step, ...]:
        _, rows = self.actuators[node]
        part = Assign(step.at, f"{COMMAND}_{node}", {COMMAND: np.eye(self.policy.model.inputs)[rows]})
        if node not in self.links:
            return (part,)
        labels = tuple(self.label(sent) for sent in self.all if node in sent)
        return (part, Send(step.at, node, (f"{COMMAND}_{node}",), step.on, labels))

    def _receive(self, step: Assign, node: str) -> Step:
        signal, rows = self.actuators[node]
        command = {f"{COMMAND}_{node}": np.eye(len(rows))}
        if node not in self.links:
            return Assign(node, signal, command)
        kept = step.branches[0][INPUT]
        assert not isinstance(kept, Scheduled)
        return Assign(node, signal, ({signal: kept[np.ix_(rows, rows)]}, command), Received(node))

    def _copied(self, step: Assign) -> Step:
        """Return the controller's copy of the inputs: the commands that are sent, and the old inputs of other links."""
        unit, branches = np.eye(self.policy.model.inputs), list[dict[str, Array]]()
        for sent in self.all:
            silent, terms = self.silent(sent), dict[str, Array]()
            for rows, branch in zip((silent, unit - silent), step.branches, strict=True):
                for name, matrix in branch.items():
                    assert not isinstance(matrix, Scheduled)
                    terms[name] = terms.get(name, 0.0 * matrix) + rows @ matrix
            branches.append(terms)
        return Assign(step.at, step.signal, tuple(branches), step.on)


def _number(value: float | Scheduled) -> float:
    return 0.0 if isinstance(value, Scheduled) else value


def _weighs(form: Form) -> bool:
    return form.Psi is not None or bool(form.plus) or bool(np.any(_number(form.constant)))
