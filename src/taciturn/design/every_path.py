"""Bounds on the cost of not sending that hold on every path: for any linear controller, number of nodes, and noise.

Each node follows the response q of the loop to its own silence (``base/response``), and knows what silence of this step
adds to the cost of this response, a = d'S d + 2 d'Y q. So the sum of its own a is a certificate that a running node
measures: on every path and at every time, √J ≤ √J_b + Σ_l √(Σa_l/T), J_b the cost of sending every sample on that path.
Three rules bound it in advance:

* **Bank.** A bank has an income g in every step: b ← b + g. The node may be silent if a ≤ ηb, and then pays: b ← b − a.
  The bank is never overdrawn, so Σa ≤ gT at every T: √J ≤ √J_b + Σ√g_l.
* **Relative.** The income is κ² times the part of the stage cost that the node has measured itself. With disjoint parts
  of the nodes, √J ≤ √J_b/(1 − √Σκ_l²), under any load, whatever the noise is.
* **Threshold.** The node may be silent if a ≤ δ: √J ≤ √J_b + Σ√(δ_l(1 − r_l)), r_l the rate of link l.

Links of one node may be decided together: the node has one response, and chooses the set of packets for which a minus
the price of the packets that it saves, λ = ηb or δ times their share, is least.

A packet that is lost, with an acknowledgement that says so, leaves the node silent: its a counts, the bank may be
overdrawn, and the node then sends until the bank has recovered. So only the certificate holds, and no bound in advance.

At its start, and when it has lost its state, a node does not know what its receiver uses. So it sends until a packet
has arrived (``begun``), and its certificate begins there: it has one root for each of these lives.

Source: minkowski1896
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product
from math import sqrt
from typing import Literal, TypeAlias

import numpy as np

from taciturn._arrays import Array, flag, instance, number, symmetrised
from taciturn._display import Displayed
from taciturn._text import number_of
from taciturn.base.certainty import Actuation, design_certainty, expect_average
from taciturn.base.filter import HELD, SEND
from taciturn.base.given_controller import CONSTANT, GivenLoop
from taciturn.base.nominal import Nominal
from taciturn.base.response import EverySample, Response, effect_ratio
from taciturn.design.around_controller import (
    PRIOR,
    REGISTER,
    Around,
    FilteredSteps,
    GivenSteps,
    Model,
    Silenced,
    model_of,
    model_of_estimate,
)
from taciturn.design.bounds import LARGEST_PARAMETER, shares_of, threshold_of
from taciturn.design.several_nodes import MOST_LINKS, SILENT, expect_ideal_sets, label, sets_of
from taciturn.errors import ProblemError, UnstableError
from taciturn.lqg.discrete import Discrete, discretise
from taciturn.model.controller import AnyController, Controller
from taciturn.model.cost import Cost
from taciturn.model.coverage import BURSTS, THEORY
from taciturn.model.network import Network
from taciturn.model.plant import ContinuousPlant, Plant, altered
from taciturn.model.policy import Policy
from taciturn.model.silence import SilenceCost
from taciturn.model.steps import Assign, Condition, Decide, Evaluate, Step, Terms
from taciturn.model.theory import Guarantee, Theory, rounded_up, with_silence
from taciturn.model.trigger import Form, Trigger

RuleName: TypeAlias = Literal["bank", "relative", "threshold"]
RULES: tuple[RuleName, ...] = ("bank", "relative", "threshold")
MEASURED = 1e-9  # relative difference of two weights that is a rounding error
TRIED, FEW = 5, 2  # factors of a gain that are tried, of so many inputs; with more, the ends of its range
SPENT = 0.1  # usual share of the bank that one silence may spend
LOST = (
    "links drop packets: the certificate that the nodes measure holds, but no guarantee in advance; J_all is the cost "
    "without losses"
)
UNTOLD = (
    "links drop packets without acknowledgement, and senders assume that packets arrive: neither a guarantee nor the "
    "certificate of the nodes holds"
)
BANKED = "g_l the income of the bank of link l"
LIMITED = "δ_l the most that a silence of link l may add, r_l its rate"
NO_LINK = "all nodes are at the controller's place, so no link decides; expected a node with a link"
STARTS = frozenset({"Trigger.excluded"})  # a node that starts is not silent before its first packet


@dataclass(frozen=True, eq=False, repr=False)
class MeasuredCost(Displayed):
    """A stage cost y'Qy + u'Ru of outputs and inputs. Each node can measure a part of this cost."""

    Q: Array  # weight of the outputs, (p, p)
    R: Array  # weight of the inputs, (m, m)
    noise: float  # what the noise of the outputs adds to this cost, tr(QV)

    @staticmethod
    def of(problem: Discrete) -> MeasuredCost:
        """Write the stage cost of a problem as a function of outputs and inputs.

        Raises:
            ProblemError: the plant is continuous, or the cost weighs what no output shows.
        """
        if problem.sampled:
            raise ProblemError(
                "rule = 'relative', but the plant is continuous in time, so its cost is an integral that no node can "
                "measure; expected rule = 'bank', or a discrete plant"
            )
        if problem.source is not None and problem.source.transport is not None:
            raise ProblemError(
                f"rule = 'relative', but links delay their packets ({problem.source.transport.text()}), so the cost of "
                "a step has inputs and outputs of other steps; expected rule = 'bank', or no delays"
            )
        if len(problem.plant.registers):
            raise ProblemError(
                "rule = 'relative', but the outputs depend on the input of the previous step (plant.D), so no node "
                "can measure its part of the cost alone; expected rule = 'bank', or no plant.D"
            )
        if problem.source is not None and problem.source.exosystem is not None:
            raise ProblemError(
                "rule = 'relative', but the plant has disturbances or set-points that change, so its cost contains "
                "deviations that no sensor measures; expected rule = 'bank', or neither disturbances nor changing "
                "set-points"
            )
        return MeasuredCost._of(problem.plant.C, problem.plant.V, problem.Q, problem.R, problem.N)

    @staticmethod
    def at_samples(plant: Plant | ContinuousPlant, cost: Cost) -> MeasuredCost:
        """Write the stage cost at sampling instants as a function of outputs and inputs, without the cost between
        samples.
        """
        return MeasuredCost._of(plant.C, plant.V, cost.Q, cost.R, cost.N)

    @staticmethod
    def _of(C: Array, V: Array, weight: Array, R: Array, N: Array) -> MeasuredCost:
        inverse = np.asarray(np.linalg.pinv(C), dtype=np.float64)
        Q = symmetrised(inverse.T @ weight @ inverse)
        q, r = (np.sqrt(np.maximum(np.diag(one), 0.0)) for one in (weight, R))  # so that units do not matter
        if (np.abs(C.T @ Q @ C - weight) > MEASURED * np.outer(q, q)).any() or (
            np.abs(N) > MEASURED * np.outer(q, r)
        ).any():
            raise ProblemError(
                "the cost weights states that the outputs do not measure, or products of states and inputs, so the "
                "nodes cannot measure the cost; expected a cost of outputs and inputs (output_variance and "
                "input_variance), or a policy with rule = 'bank'"
            )
        return MeasuredCost(Q, R, float(np.sum(Q * V)))

    def part(self, entries: Sequence[int]) -> Array:
        """Return the weights of the listed outputs and inputs; raise an error if others have cross weights with
        them.
        """
        p = len(self.Q)
        whole = np.block([[self.Q, np.zeros((p, len(self.R)))], [np.zeros((len(self.R), p)), self.R]])
        at = [*entries]
        others, size = [i for i in range(len(whole)) if i not in at], np.sqrt(np.maximum(np.diag(whole), 0.0))
        if (np.abs(whole[np.ix_(at, others)]) > MEASURED * np.outer(size[at], size[others])).any():
            raise ProblemError(
                "rule = 'relative', but the cost contains products of signals of different nodes; expected a cost "
                "without such products, or rule = 'bank'"
            )
        return whole[np.ix_(at, at)]


@dataclass(frozen=True, eq=False, repr=False)
class Allowed(Displayed):
    """The cost that not sending may add: the name of a rule, and one number per group of links decided together."""

    rule: RuleName
    # for the bank its income per step, for the threshold its limit, and for the relative bank κ
    limits: Mapping[tuple[str, ...], float]
    spent: float  # η, the share of the bank that one silence may spend; 1 for a threshold
    factors: Mapping[tuple[str, ...], float]  # ρ, by which an effect may exceed the computed one
    shares: Mapping[str, float]  # of links that are decided together, by which their packets are worth more or less

    @property
    def added(self) -> float:
        """(Σρ_l√δ_l)², where the incomes or thresholds δ_l are the numbers in ``limits``."""
        return sum(self.factors[group] * sqrt(limit) for group, limit in self.limits.items()) ** 2

    @property
    def share(self) -> float:
        """√Σ(ρ_lκ_l)², where the factors κ_l are the numbers in ``limits``."""
        return sqrt(sum((self.factors[group] * kappa) ** 2 for group, kappa in self.limits.items()))


@dataclass(frozen=True, eq=False, repr=False)
class Asked(Displayed):
    """The arguments that the policy kind ``distributed`` has for a bound on every path."""

    rule: RuleName
    delta: float | None = None
    theta: float | None = None
    kappa: float | None = None
    shares: Mapping[str, float] | None = None
    spend: float | None = None
    joint: bool | None = None
    prediction: Actuation = "hold"
    actuation: Actuation = "hold"
    gain_range: Sequence[float] | None = None
    plants: tuple[Plant | ContinuousPlant, ...] = ()


class OwnSilence:
    """Rule by which each node limits the cost that its own unsent packets add."""

    def __init__(
        self,
        problem: Discrete,
        controller: Controller,
        network: Network,
        *,
        together: bool,
        sensing: Model | None,
        acting: Model | None,
    ) -> None:
        """Find the responses; ``allow`` states their allowed cost."""
        self._problem, self._network = problem, network
        self.around = Around(network, problem.plant, self, sensing=sensing, acting=acting, together=together)
        loop = EverySample.of(problem, controller)
        self.groups = self.around.groups
        self._responses = self._of(loop)
        self._allowed: Allowed | None = None

    def _of(self, loop: EverySample) -> Mapping[tuple[str, ...], Response]:
        return {group: loop.response(self.around.errors(group)) for group in self.groups}

    def factors(self, loops: Sequence[EverySample]) -> dict[tuple[str, ...], float]:
        """Return, for each node, by what factor its effect in the given loops may exceed its computed effect."""
        found = dict.fromkeys(self.groups, 1.0)
        for responses in map(self._of, loops):
            for group, true in responses.items():
                found[group] = max(found[group], effect_ratio(self._responses[group], true))
        return found

    def allow(self, allowed: Allowed) -> None:
        """Set the cost that not sending may add to the cost of the loop."""
        self._allowed = allowed

    @property
    def allowed(self) -> Allowed:
        """The cost that not sending may add, as set with ``allow``."""
        assert self._allowed is not None, "a rule without limits has no steps"
        return self._allowed

    @cached_property
    def _measured(self) -> Mapping[tuple[str, ...], tuple[tuple[str, ...], Array]]:
        """The signals that a node measures itself, and their weight in the stage cost, for the relative bank."""
        if self.allowed.rule != "relative":
            return {}
        cost, plant, found = (
            MeasuredCost.of(self._problem),
            self._problem.plant,
            dict[tuple[str, ...], tuple[tuple[str, ...], Array]](),
        )
        seen = {
            node: signal for signal, (node, _) in self._network.measurements(plant.sensed, plant.set_points).items()
        }
        for group, kappa in self.allowed.limits.items():
            sensor = group[0] in seen
            names = (seen[group[0]],) if sensor else tuple(f"{HELD}_{link}" for link in group)
            found[group] = names, kappa**2 * cost.part(self.around.errors(group))
        return found

    @property
    def silence(self) -> dict[tuple[str, ...], SilenceCost]:
        """For each group of links, the names of the signals in which its node stores the cost of not sending."""
        return {
            group: SilenceCost(
                self._network.sender(group[0]),
                _name("added", group),
                _name("silence", group),
                _name("lasted", group),
                _name("response", group) if self._responses[group].states else "",
                self.allowed.factors[group],
            )
            for group in self.groups
        }

    def decision(self, links: Sequence[Silenced]) -> str:
        """Return the name of the decision that a node takes on its links."""
        return _name(SEND, _group(links))

    def sends(self, links: Sequence[Silenced]) -> Sequence[tuple[str, frozenset[str]]]:
        """Return each label of the decision with the set of links that send. With the first label, no link sends."""
        if len(links) == 1:
            return ((SILENT, frozenset()), (SEND, frozenset({links[0].link})))
        return [(label(sent), frozenset(sent)) for sent in self._sets(links)]

    def decide(self, at: str, links: Sequence[Silenced]) -> tuple[Step, ...]:
        """Return the policy steps that compute the cost of each set of packets, and the decision which set to send."""
        group, allowed = _group(links), self.allowed
        response, limit = self._responses[group], allowed.limits[group]
        bank, begun = _name("bank", group), _name("begun", group)
        found, options, excluded = list[Step](), dict[str, Form](), dict[str, tuple[Form, ...]]()
        if allowed.rule == "bank":
            found.append(Evaluate(at, bank, (Form(constant=limit, plus={bank: 1.0}),)))
        elif (measured := self._measured[group] if allowed.rule == "relative" else None) and self._is_sensor(group):
            found.append(Evaluate(at, bank, (Form(*measured, plus={bank: 1.0}),)))
        labels = self.sends(links)
        for name, sent in labels[:-1]:
            silent = [i for i, one in enumerate(links) if one.link not in sent]
            entries = _entries(links, silent)
            signals = (*(links[i].moved for i in silent), *((_name("response", group),) if response.states else ()))
            cost, saved = _cost(name, group), self._saved(links, silent)
            found.append(Evaluate(at, cost, (Form(signals, response.added(entries)),)))
            if allowed.rule == "threshold":
                options[name] = Form(constant=-saved * limit, plus={cost: 1.0})
            else:
                options[name] = Form(plus={cost: 1.0, bank: -saved * allowed.spent})
            excluded[name] = (Form(constant=1.0, plus={begun: -1.0}),)  # positive until a packet has arrived
        options[labels[-1][0]] = Form()
        return (*found, Decide(at, self.decision(links), Trigger(options, excluded=excluded)))

    def after(self, at: str, links: Sequence[Silenced], told: Condition) -> tuple[Step, ...]:
        """Return the policy steps after the packets, which sum the cost of not sending and update response and bank."""
        group, allowed = _group(links), self.allowed
        response = self._responses[group]
        outcomes = [sent for _, sent in self.sends(links)]
        names = [_cost(name, group) for name, _ in self.sends(links)[:-1]]
        added, total, moved = _name("added", group), _name("silence", group), _name("response", group)
        begun, bank, lasted = _name("begun", group), _name("bank", group), _name("lasted", group)
        found: list[Step] = [
            Evaluate(at, added, (*(Form(plus={name: 1.0}) for name in names), Form()), told),
            *_sum_up(at, group, added, total),
            Evaluate(at, begun, (*[Form(plus={begun: 1.0})] * len(names), Form(constant=1.0)), told),
            Evaluate(at, lasted, (Form(plus={lasted: 1.0, begun: 1.0}),)),
        ]
        if response.states:
            branches = list[Terms]()
            for sent in outcomes:
                silent = [i for i, one in enumerate(links) if one.link not in sent]
                pushed = {links[i].moved: response.G[:, _entries(links, [i])] for i in silent}
                branches.append({moved: response.F, **pushed})
            found.append(Assign(at, moved, tuple(branches), told))
        if allowed.rule != "threshold":
            paid, income = {bank: 1.0, added: -1.0}, ((), None)
            if allowed.rule == "relative" and not self._is_sensor(group):  # the inputs are known only now
                income = self._measured[group]
            found.append(Evaluate(at, bank, (Form(*income, plus=paid),)))
        return tuple(found)

    def _is_sensor(self, group: tuple[str, ...]) -> bool:
        return self._network.sender(group[0]) == group[0]

    def _sets(self, links: Sequence[Silenced]) -> Sequence[tuple[str, ...]]:
        return sets_of(_group(links), {one.link: self._network.links[one.link].price for one in links})

    def _saved(self, links: Sequence[Silenced], silent: Sequence[int]) -> float:
        """Return the share of silent links in the worth of all packets; all links together may spend the whole.

        A packet is worth its price times the share of its link: with the share 0, the link is not worth a silence.
        """
        shares = self.allowed.shares
        worth = [self._network.links[one.link].price * shares.get(one.link, 1.0) for one in links]
        return sum(worth[i] for i in silent) / whole if (whole := sum(worth)) else 0.0


def bound_on_every_path(problem: Discrete, base: float, allowed: Allowed) -> Guarantee:
    """Return the bound on the average cost of a policy whose nodes limit, on every path, the cost of not sending.

    ``base`` is the cost of sending every sample, per step or in total, without the noise between samples.
    """
    without = ", without the inter-sample noise cost" if problem.noise_cost else ""
    wide = any(factor > 1 for factor in allowed.factors.values())
    plants = "every stated plant" if wide else "this plant"
    every = (
        f"on every path and at every time, for {plants}, any noise and any load: J_b the cost of sending every sample "
        "on that path"
    )
    roots = "Σρ_l√" if wide else "Σ√"
    off = ", ρ_l by how much its effect may exceed the computed one" if wide else ""
    if allowed.rule == "relative":
        measured = MeasuredCost.of(problem).noise * problem.ticks
        cost = (base + measured) / (1 - allowed.share) ** 2 - measured
        return Guarantee(
            rounded_up(problem.per_unit(cost)),
            f"√J ≤ √J_b/(1 − √Σ{'(ρ_lκ_l)²' if wide else 'κ_l²'}) {every}, both with the noise of the outputs{off}",
            "minkowski1896",
            more_sends=True,
            every_path=True,
        )
    scale, pull = problem.ticks / problem.unit, sqrt(base / problem.unit)
    bank = allowed.rule == "bank"
    return Guarantee(
        rounded_up(problem.per_unit(with_silence(base, allowed.added * problem.ticks, sqrt(base)))),
        f"√J ≤ √J_b + {roots}{'g_l' if bank else '(δ_l(1 − r_l))'} {every}{without}; "
        f"{BANKED if bank else LIMITED}{off}",
        "minkowski1896",
        None if bank else problem.per_unit(base),
        deciders={}
        if bank
        else {group: allowed.factors[group] ** 2 * delta * scale for group, delta in allowed.limits.items()},
        more_sends=True,
        pull=0.0 if bank else pull,
        every_path=True,
    )


@dataclass(frozen=True, eq=False, repr=False)
class EveryPath(Displayed):
    """The loop that sends every sample. A policy has a bound on every path relative to the cost of this loop."""

    kind: str  # of the policy
    problem: Discrete
    control: FilteredSteps | GivenSteps
    nominal: Nominal
    start: Array  # state of the controller at the first step
    posterior: Array | None = None  # covariance of the estimate of LQG
    given: GivenLoop | None = None  # the loop of a given controller

    @staticmethod
    def of_lqg(kind: str, plant: Plant | ContinuousPlant, cost: Cost, period: float | None) -> EveryPath:
        """Return the loop of LQG control for a plant and a cost."""
        problem = discretise(plant, cost, period)
        certainty = design_certainty(kind, problem)
        nominal = Nominal(problem, certainty.cost_all_time, certainty.settling, certainty.error, certainty.recovery)
        steps = FilteredSteps(problem.plant, certainty.filter.gain, certainty.regulator.L)
        return EveryPath(kind, problem, steps, nominal, problem.plant.mean, certainty.filter.posterior)

    @property
    def base(self) -> float:
        """Cost of sending every sample, per step or in total, without the noise between sampling instants."""
        return self.nominal.cost

    def policy(self, network: Network, asked: Asked, others: Sequence[EveryPath] = ()) -> Policy:
        """Return the policy. Its bound also holds if the plant is that of one of the loops ``others``."""
        lossy = [link for link in network.links if network.loss(link) > 0]
        told = all(network.acknowledges(link) for link in lossy)
        modes = asked.prediction, asked.actuation
        models, controller = self._models(modes), self.control.controller
        silence = OwnSilence(
            self.problem,
            controller,
            network,
            together=_decided_together(self.kind, network, asked.joint),
            sensing=models[0],
            acting=models[1],
        )
        factors = silence.factors([EverySample.of(one.problem, controller) for one in others])
        banked = asked.rule != "threshold"
        spent = number("spend", SPENT if asked.spend is None else asked.spend, 0.0, 1.0, closed=True) if banked else 1.0
        if asked.spend is not None and (not banked or spent == 0):
            raise ProblemError(
                f"spend = {asked.spend:g} is given with rule = {asked.rule!r}; expected 0 < spend ≤ 1, and rule = "
                "'bank' or 'relative'"
            )
        allowed = Allowed(asked.rule, self._limits(network, asked, factors), spent, factors, asked.shares or {})
        silence.allow(allowed)
        control = self.control
        if modes[1] == "model" and isinstance(control, GivenSteps):
            control = replace(control, gain=self.problem.filter().gain)
        steps = silence.around.steps(control)
        initial = self._begun(silence.around, control)
        if self.given is not None:
            applied = dict(network.applications(self.problem.plant.inputs).values())
            initial = self.given.point.begun(steps, initial, applied)
        claims = Theory(
            cost_lqg=None if self.given is None else self.given.cost_lqg,
            guarantee=None if lossy else bound_on_every_path(self.problem, self.base, allowed),
            silence=silence.silence if told else {},
            covers=THEORY | STARTS | (BURSTS if told else frozenset[str]()),
        )
        notes = [*(() if self.given is None else self.given.beside_lqg(self.base))]
        notes += [LOST if told else UNTOLD] if lossy else []
        notes += [_wide(asked, factors)] if others else []
        return self.nominal.policy(
            self.kind,
            steps,
            initial,
            claims,
            sites=silence.around.sites,
            network=network,
            # that a constant disturbance costs more than computed does not concern a bound for every load
            notes=(*notes, *(() if self.given is None else (one for one in self.given.notes if one != CONSTANT))),
        )

    def _models(self, modes: tuple[Actuation, Actuation]) -> tuple[Model | None, Model | None]:
        """Return the models by which both ends of links predict outputs and commands."""
        if "model" not in modes:
            return None, None
        if isinstance(self.control, FilteredSteps):
            assert self.posterior is not None, "LQG has a filter"
            model = model_of_estimate(self.problem, self.control.L, self.posterior)
        else:
            model = model_of(self.problem, self.control.controller, self.start)
        return tuple(model if mode == "model" else None for mode in modes)  # type: ignore[return-value]

    def _begun(self, around: Around, control: FilteredSteps | GivenSteps) -> dict[str, Array]:
        plant, filters = self.problem.plant, isinstance(control, FilteredSteps) or control.gain is not None
        found = around.begun(plant.C @ plant.mean)
        if len(self.start) and not isinstance(control, FilteredSteps):
            found[REGISTER] = self.start
        return {**found, **({PRIOR: plant.mean} if filters else {})}

    def _limits(
        self, network: Network, asked: Asked, factors: Mapping[tuple[str, ...], float]
    ) -> dict[tuple[str, ...], float]:
        """Return the income, the threshold or κ of each group of links."""
        weights = weights_of(network, [*factors], asked.shares)
        if asked.rule == "relative":
            noise = MeasuredCost.of(self.problem).noise
            whole = self.base / self.problem.ticks + noise
            return _kappas(weights, factors, asked, noise / whole if whole else 0.0)
        if asked.kappa is not None:
            raise ProblemError(
                f"kappa is given with rule = {asked.rule!r}, which does not use it; expected rule = 'relative', or "
                "theta or delta in place of kappa"
            )
        per_step = self.base / self.problem.ticks
        whole = threshold_of(per_step, asked.delta, asked.theta)
        if asked.theta is None:
            return {group: whole * weight**2 for group, weight in weights.items()}
        whole = (sqrt(1 + asked.theta) - 1) ** 2 * per_step  # so that the bound is (1 + θ) J_b
        return {group: whole * (weight / factors[group]) ** 2 for group, weight in weights.items()}


def design_on_every_path(
    kind: str,
    plant: Plant | ContinuousPlant,
    cost: Cost,
    period: float | None,
    kept: AnyController | None,
    network: Network,
    asked: Asked,
) -> Policy:
    """Design the policy of a given controller, or of LQG control, whose cost is bounded on every path."""
    others = [
        _other(kind, one, cost, period, kept)
        for one in (*_plausible(plant, asked.gain_range), *_others(plant, asked.plants))
    ]
    return loop_of_every_path(kind, plant, cost, period, kept).policy(network, asked, others)


def _other(
    kind: str, plant: Plant | ContinuousPlant, cost: Cost, period: float | None, kept: AnyController | None
) -> EveryPath:
    """Return the loop of another plant for which a bound is to hold."""
    try:
        if kept is None:
            return EveryPath.of_lqg(kind, plant, cost, period)
        return loop_of_every_path(kind, plant, cost, period, kept)
    except UnstableError as error:
        raise UnstableError(
            f"a plant within gain_range, or one of 'plants', is refused: {error}; expected plants for which the loop "
            "that sends every sample is stable"
        ) from None


def _plausible(plant: Plant | ContinuousPlant, gains: Sequence[float] | None) -> list[Plant | ContinuousPlant]:
    """Return plants whose input gains are within a range of factors of the stated ones, each for itself."""
    if gains is None:
        return []
    low, high = (gains[0], gains[-1]) if len(gains) == 2 else (0.0, 0.0)
    if not (len(gains) == 2 and 0 < low <= 1 <= high):
        raise ProblemError(
            f"gain_range is {list(gains)}; expected the smallest and the largest factor of the input gains, such as "
            "[0.8, 1.2]"
        )
    if isinstance(plant, Plant) and plant.function is not None:
        raise ProblemError(
            "gain_range is given, but the plant is nonlinear (plant.function); expected a linear plant, or no "
            "gain_range"
        )
    each = np.linspace(low, high, TRIED if plant.inputs <= FEW else 2)
    return [altered(plant, {"B": plant.B * np.array(one)}) for one in product(each.tolist(), repeat=plant.inputs)]


def _others(
    plant: Plant | ContinuousPlant, plants: Sequence[Plant | ContinuousPlant]
) -> Iterator[Plant | ContinuousPlant]:
    """Yield other plants with the disturbances and set-points of a plant, after a check of their sizes."""
    for place, one in enumerate(plants):
        instance(f"plants[{place}]", one, type(plant))
        sizes = [(len(p.A), p.inputs, len(p.C)) for p in (one, plant)]
        if sizes[0] != sizes[1]:
            raise ProblemError(
                f"plants[{place}] has {number_of(sizes[0][0], 'state')}, {number_of(sizes[0][1], 'input')} and "
                f"{number_of(sizes[0][2], 'output')}; expected "
                f"{number_of(sizes[1][0], 'state')}, {number_of(sizes[1][1], 'input')} and "
                f"{number_of(sizes[1][2], 'output')}, as in the plant of the design"
            )
        yield altered(one, {"exosystem": plant.exosystem})


def _wide(asked: Asked, factors: Mapping[tuple[str, ...], float]) -> str:
    """Return a note on the plants for which a bound holds."""
    found = list[str]()
    if asked.gain_range is not None:
        low, high = asked.gain_range
        found.append(f"input gains from {low:g} to {high:g} times the stated ones, each for itself")
    if asked.plants:
        found.append(f"{len(asked.plants)} further plants")
    each = ", ".join(f"{' and '.join(group)} {factor:.4g}" for group, factor in factors.items())
    return (
        f"the bound also holds for {' and for '.join(found)}: silence has at most this many times the computed effect: "
        f"{each} (searched over plants and frequencies)"
    )


def loop_of_every_path(
    kind: str, plant: Plant | ContinuousPlant, cost: Cost, period: float | None, kept: AnyController | None
) -> EveryPath:
    """Return the loop that sends every sample, with a given controller or with LQG control."""
    if cost.discount < 1:
        raise ProblemError(
            f"cost.discount is {cost.discount:g}, but the bound on every path applies to averages over time; expected "
            "an average cost, or a cost with a horizon"
        )
    if kept is None:
        expect_average(kind, cost)
        found = EveryPath.of_lqg(kind, plant, cost, period)
    else:
        loop = GivenLoop.of(plant, cost, period, kept)
        base = loop.every_sample()
        value, whole = loop.value(base)
        nominal = loop.nominal(whole, value.settling, None if cost.mission else base)
        found = EveryPath(
            kind, loop.problem, GivenSteps(loop.controller, loop.problem.plant), nominal, loop.point.start, None, loop
        )
    if found.problem.plant.saturation is not None:
        limit = "input_rate" if found.problem.plant.input_limit is None else "input_limit"
        raise ProblemError(
            f"plant.{limit} is given, so the loop is not linear, and the bound on every path does not hold; expected "
            "inputs without limits, or the policy kind 'excess' with one link"
        )
    return found


def _decided_together(kind: str, network: Network, joint: bool | None) -> bool:
    """Return whether the controller decides on all its links together."""
    links = [node for node in network.actuators if node in network.links]
    ideal = all(network.links[link].ideal for link in links)
    if joint is None:
        return 1 < len(links) <= MOST_LINKS and ideal
    if flag("joint", joint):
        expect_few(links)
        expect_ideal_sets(network, kind, links)
    return joint and len(links) > 1


def weights_of(
    network: Network, groups: list[tuple[str, ...]], shares: Mapping[str, float] | None
) -> dict[tuple[str, ...], float]:
    """Return the share of each group of links in the sum Σ√δ, which is a part of the bound."""
    links = list(network.links)
    if not links:
        raise ProblemError(NO_LINK)
    given = shares_of(shares, links)
    total = sum(given.values())
    if total == 0:
        raise ProblemError("shares = 0 for all links; expected a positive share for at least one link")
    return {group: sum(given[link] for link in group) / total for group in groups}


def _kappas(
    weights: Mapping[tuple[str, ...], float], factors: Mapping[tuple[str, ...], float], asked: Asked, noise: float
) -> dict[tuple[str, ...], float]:
    """Return κ_l of each group of links, with √Σκ_l² = κ; ``noise`` is the share of noise in the cost of outputs."""
    theta, kappa = asked.theta, asked.kappa
    if asked.delta is not None or (theta is None) == (kappa is None):
        raise ProblemError(
            "rule = 'relative' is given with both or neither of the parameters kappa and theta; expected exactly one "
            "of them"
        )
    if theta is not None:
        most = number("theta", theta, 0.0, LARGEST_PARAMETER, closed=True)
        kappa = 1 - 1 / sqrt(1 + most * (1 - noise))  # so that the bound on J without this noise is (1 + θ) J_b
    kappa = number("kappa", 0.0 if kappa is None else kappa, 0.0, 1.0, closed=True)
    wide = 1.0 if theta is None else sqrt(sum((weights[group] * factors[group]) ** 2 for group in weights))
    length = sqrt(sum(weight**2 for weight in weights.values())) if theta is None else wide
    found = {group: kappa * weight / length for group, weight in weights.items()}
    if sum((factors[group] * one) ** 2 for group, one in found.items()) >= 1 - MEASURED:
        raise ProblemError(
            f"kappa is {kappa:g}, but the bound J_b/(1 − κ)² is finite only for κ < 1; expected kappa < 1"
        )
    return found


def expect_few(links: list[str]) -> None:
    """Raise an error if the given links are too many for a joint decision, which considers every set of links."""
    if len(links) > MOST_LINKS:
        raise ProblemError(
            f"joint = true, so the controller would choose among the {2 ** len(links)} sets of {len(links)} actuator "
            f"links; expected at most {MOST_LINKS} actuator links, or joint = false"
        )


def _group(links: Sequence[Silenced]) -> tuple[str, ...]:
    return tuple(one.link for one in links)


def _entries(links: Sequence[Silenced], chosen: Sequence[int]) -> list[int]:
    """Return the entries of the error of all links that belong to some of them."""
    starts = np.concatenate([[0], np.cumsum([one.size for one in links])]).tolist()
    return [entry for i in chosen for entry in range(int(starts[i]), int(starts[i + 1]))]


def _name(what: str, group: tuple[str, ...]) -> str:
    return f"{what}_{' and '.join(group)}"  # no name of a node contains spaces


def _sum_up(at: str, group: tuple[str, ...], added: str, total: str) -> tuple[Step, ...]:
    """Return the steps that add a number to a sum, with the rounding of the sum carried over (Kahan's summation)."""
    # in single precision, a plain sum of 1e8 steps would stop to grow, and the certificate would be too small
    rest, fresh, summed = (_name(what, group) for what in ("carry", "fresh", "summed"))
    return (
        Evaluate(at, fresh, (Form(plus={added: 1.0, rest: -1.0}),)),
        Evaluate(at, summed, (Form(plus={total: 1.0, fresh: 1.0}),)),
        Evaluate(at, rest, (Form(plus={summed: 1.0, total: -1.0, fresh: -1.0}),)),
        Evaluate(at, total, (Form(plus={summed: 1.0}),)),
    )


def _cost(name: str, group: tuple[str, ...]) -> str:
    """Return the name of the cost that a silence would add; with several links, ``name`` states which send."""
    return _name("cost", group) if len(group) == 1 else f"{_name('cost', group)} if {name}"
