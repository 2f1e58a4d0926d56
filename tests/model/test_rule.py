"""The rule by which a link sends: a plain sentence that decides as the policy's trigger does."""

from __future__ import annotations

import math
import re
from functools import cache
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from catalogue import KEEPING, POLICIES
from counts import few
from drawn import law
from hypothesis import strategies as st
from runtime.silent import CASES, problem_of
from runtime.test_nodes import TANKS
from systems import make_system

import taciturn
from taciturn import Cost, Network, Plant, Policy, design
from taciturn.design.catalogue import CATALOGUE
from taciturn.model.rule import Rule, choice_of, pattern_text
from taciturn.model.steps import Assign, Decide, Send
from taciturn.model.trigger import Form, GaussianTerm, Scheduled, Trigger
from taciturn.model.words import Words
from taciturn.renewal.without_steps import nodes_of
from taciturn.study.describe import describe
from taciturn_new.draft import example_of

SYSTEM = make_system(5, 2, 1, 2, full_state=False)
OWN = {"a": 1, "b": 2, "d": 3}  # signals of one's own, with their sizes
LETTER, EXPONENT = "ΨΘΦΛΞΩ", "ΠΓΣ"
NAMES = (
    *POLICIES,
    *(f"kind {kind}" for kind in CATALOGUE if kind not in POLICIES),
    *(f"kept {name}" for name in KEEPING),
    *(f"tank {name}" for name in TANKS),
    *(f"path {name}" for name in CASES),
)


def problem(name: str) -> taciturn.Problem:
    """Return the problem of a name that begins with its group."""
    group, _, rest = name.partition(" ")
    if group == "path":
        return problem_of(rest)
    if group == "kind":
        return example_of(CATALOGUE[rest])
    file, changes = ("pid-tank", KEEPING[rest]) if group == "kept" else ("quadruple-tank", TANKS[rest])
    return taciturn.load(file).changed(dict(changes))


@cache
def made(name: str) -> Policy:
    """Return a policy of the tests by name."""
    found = POLICIES[name](SYSTEM) if name in POLICIES else nodes_of(problem(name).designed())
    assert found is not None
    return found


def rules(policy: Policy) -> dict[str, Rule]:
    """Return the rule of each link."""
    return {link.name: link.rule for link in policy.diagram().links}


def sentences(policy: Policy) -> list[str]:
    """Return the sentence of each link."""
    return [rule.sentence for rule in rules(policy).values()]


def expect_plain(text: str) -> None:
    """Check that a text has no name of a signal, and none of the words of an interpreter."""
    assert "_" not in text
    assert not re.search(r"≠|None|nan|\binf\b|Psi", text)


@pytest.mark.parametrize("name", few(NAMES, 40))
def test_every_rule_is_a_plain_sentence_whose_symbols_are_explained(name: str) -> None:
    """Of every kind, every rule around a controller, every network; also each decision that sends nothing."""
    policy = made(name)
    found = rules(policy)
    assert list(found) == [step.link for step in policy.steps if isinstance(step, Send)]
    told = {step.on for step in policy.steps if isinstance(step, Send)}.union(
        *(rule.follows for rule in found.values())
    )
    others = [step for step in policy.steps if isinstance(step, Decide) and step.decision not in told]
    for rule in [*found.values(), *(choice_of(policy, step) for step in others)]:
        expect_plain(" ".join((rule.sentence, *rule.explained)))
        text = " ".join((rule.sentence, *rule.symbols.values()))
        formulas = re.findall(rf"(\S+?)'([{LETTER}{EXPONENT}]\d?)(?=\1)", text)
        assert {letter for _, letter in formulas} == set(rule.matrices)
        lengths = re.findall(r"\|([^|]+)\|", text)
        named = {re.sub(r"(?<=\D)\d+$", "", symbol) for symbol in rule.symbols} | set(rule.symbols)
        for symbol in (*(symbol.lstrip("(−") for symbol, _ in formulas), *lengths):
            assert {symbol, re.sub(r"(?<=\D)\d+$", "", symbol)} & named, (symbol, rule.symbols)
        assert all(rule.symbols.values())
    for rule in found.values():
        assert rule.sentence.startswith(("sends when ", "sends at ", "sends with probability ", "never sends"))


def own_policy(trigger: Trigger) -> Policy:
    """Return a policy whose sender compares signals of its own."""
    plant = Plant(np.diag([0.5, 0.4]), [[1.0], [0.5]], np.eye(2), dt=0.5)
    sizes = [*OWN.items(), ("credit left", 1), ("load", 1)]
    computed = tuple(Assign("controller", name, {"y": np.ones((size, 2))}) for name, size in sizes)
    steps = (
        *computed,
        Decide("controller", "go", trigger),
        Assign("controller", "wish", {"y": np.ones((1, 2))}),
        Send("controller", "actuator", ("wish",), "go"),
        Assign("actuator", "input", {"wish": np.eye(1)}),
    )
    return Policy("own", steps, plant, sites=(frozenset({"sensor", "controller"}),), network=Network())


def drawn_form(draws: np.random.Generator) -> Form:
    """Return a form with blocks of every shape: zero, one entry, a multiple of the identity, any, and coupled ones."""
    names = tuple(name for name in OWN if draws.random() < 0.6)
    sizes = [OWN[name] for name in names]
    Psi = np.zeros((sum(sizes), sum(sizes)))
    ends = np.cumsum([0, *sizes])
    for start, end in pairwise(ends):
        size, block = end - start, np.zeros((end - start, end - start))
        shape = draws.integers(0, 4)
        if shape == 1:
            block[size - 1, size - 1] = draws.uniform(-2, 2)
        elif shape == 2:
            block = draws.choice([-1.0, 1.0, 0.7]) * np.eye(size)
        elif shape == 3:
            block = draws.normal(size=(size, size))
        Psi[start:end, start:end] = block + block.T
    if len(names) > 1 and draws.random() < 0.4:
        Psi[0, -1] = Psi[-1, 0] = draws.normal()
    plus = {name: float(draws.normal()) for name in ("credit left", "load") if draws.random() < 0.3}
    bell = GaussianTerm(float(draws.normal()), np.eye(len(Psi))) if names and draws.random() < 0.15 else None
    return Form(names, Psi if names else None, float(draws.normal()), plus, bell)


def decides(rule: Rule, values: dict[str, np.ndarray]) -> bool:
    """Return whether a sentence says that a packet is sent, read as a formula."""
    if rule.when in ("never", "at every step"):
        return rule.when != "never"
    known: dict[str, Any] = dict(values)
    for symbol, told in rule.symbols.items():
        if told.startswith("("):
            known[symbol] = np.concatenate([values[part] for part in told.strip("()").split(", ")])

    def number(found: re.Match[str]) -> str:
        vector = entry(found[1])
        return repr(float(vector @ np.asarray(rule.matrices[found[2]]) @ vector))

    def entry(symbol: str) -> np.ndarray:
        whole = re.fullmatch(r"([abd])(\d)", symbol)
        return values[whole[1]][int(whole[2]) - 1 : int(whole[2])] if whole else known[symbol]

    text = re.sub(r" \(\|.*?\)", "", rule.when.removeprefix("when "))  # the same said of a length
    text = re.sub(rf"exp\(−½ (\S+?)'([{EXPONENT}]\d?)\1\)", lambda m: repr(math.exp(-0.5 * float(number(m)))), text)
    text = re.sub(rf"(\S+?)'([{LETTER}]\d?)\1", number, text)
    text = re.sub(r"\|([abd]\d?)\|²", lambda m: repr(float(entry(m[1]) @ entry(m[1]))), text)
    text = re.sub(r"\|([abd]\d?)\|", lambda m: repr(float(np.linalg.norm(entry(m[1])))), text)
    text = re.sub(r"([abd]\d?)²", lambda m: repr(float(entry(m[1]).item() ** 2)), text)
    for name in ("credit left", "load"):
        text = text.replace(name, repr(float(values[name].item())))
    text = re.sub(r"(?<=[\d)]) (?=[\d(-])", " * ", text.replace("× ", "").replace("−", "-"))
    return any(bool(eval(clause)) for clause in text.split(" or "))  # of numbers alone


@law(20, 2_000, seed=st.integers(0, 2**32 - 1))
def test_a_sentence_decides_as_the_trigger_does(seed: int) -> None:
    """For forms of every shape, at values that are not at the threshold: the numbers of a sentence are rounded."""
    draws = np.random.default_rng(seed)
    options = {"silent": drawn_form(draws)} | {f"way {i}": drawn_form(draws) for i in range(draws.integers(1, 3))}
    if draws.random() < 0.3:  # two inequalities that share a matrix
        half, constants = draws.normal(size=(3, 3)), draws.uniform(-3, 3, size=2).tolist()
        shared = {f"way {i}": Form(("d",), half + half.T, constant) for i, constant in enumerate(constants)}
        options = {"silent": Form(), **shared}
    policy = own_policy(Trigger(options))
    (rule,) = rules(policy).values()
    expect_plain(rule.sentence)
    for _ in range(20):
        values = {name: draws.normal(size=size) for name, size in {**OWN, "credit left": 1, "load": 1}.items()}
        found, sizes = list[float](), list[float]()
        for form in options.values():
            eta = np.concatenate([values[name] for name in form.signals]) if form.signals else np.zeros(0)
            bell = 0.0 if form.bell is None else form.bell.height * math.exp(-0.5 * float(eta @ eta))
            squares = 0.0 if form.Psi is None else float(eta @ np.asarray(form.Psi) @ eta)
            scalars = [weight * values[name].item() for name, weight in form.plus.items()]
            assert isinstance(form.constant, float)
            found.append(squares + bell + sum(scalars) + form.constant)
            weights = 0.0 if form.Psi is None else float(np.abs(eta) @ np.abs(np.asarray(form.Psi)) @ np.abs(eta))
            sizes.append(weights + abs(bell) + sum(map(abs, scalars)) + abs(form.constant))
        least = min(found[1:])
        if abs(found[0] - least) > 0.03 * sum(sizes):
            assert decides(rule, values) == (found[0] > least), (rule.sentence, rule.symbols, values, found)


def test_one_number_is_told_in_the_unit_of_its_signal() -> None:
    """The threshold of an input error is the root of δ over its weight; that of an output is δ itself."""
    policy = taciturn.load("two-mass").design()
    silent, send = policy.decisions["send"].options.values()
    assert isinstance(send.constant, float)
    bound = math.sqrt(send.constant / np.asarray(silent.Psi).item())
    assert sentences(policy) == [f"sends when e'Ψe > {send.constant:.3g} (|e| > {bound:.3g})"]
    moved = design.send_on_delta(SYSTEM.plant, SYSTEM.cost, delta=0.25)
    assert sentences(moved) == ["sends when |Δy1| > 0.25 or |Δy2| > 0.25"]
    relative = design.relative(SYSTEM.plant, SYSTEM.cost, sigma=0.125)
    assert sentences(relative) == ["sends when |d| > 0.125 |x̂|"]


def test_probabilities_waits_plans_and_alarms_are_clauses() -> None:
    """Scalar signals are followed to what they mean."""
    policy = design.stochastic(SYSTEM.plant, SYSTEM.cost, scale=3.0)
    weight = np.asarray(policy.decisions["send"].options["silent"].Psi)[0, 0]
    assert sentences(policy) == [f"sends with probability 1 − exp(−{weight:.3g} |d|²)"]
    assert sentences(made("self-triggered")) == [
        "sends when the wait of 1 to 4 steps that it chose at its last packet is over"
    ]
    assert sentences(made("rollout")) == ["sends when a packet is due in the plan that it has chosen"]
    kept = rules(made("kept kept over bursts"))["actuator"]
    assert kept.sentence.endswith(" or surprise > 2.1 or its last packet was not acknowledged")
    assert {"watch", "retry"} <= kept.follows
    assert kept.symbols["cost of silence"] == "η'Ψη"


def test_banks_have_an_income_and_a_first_packet() -> None:
    """What a node may spend, and that it sends when it starts; with losses, until a packet has arrived."""
    gauge = rules(made("path held"))["gauge"]
    assert gauge.sentence == "sends when cost of silence > 0.1 × bank, and at its first step"
    assert re.fullmatch(r"gains \S+ in each step; pays the cost of each silence", gauge.symbols["bank"])
    assert sentences(made("path losses"))[0].endswith(", and until a packet has arrived")
    threshold = rules(made("path threshold"))["gauge"]
    assert re.fullmatch(r"sends when cost of silence > \S+, and at its first step", threshold.sentence)


def test_links_that_are_decided_together_say_so() -> None:
    """The value of each set of packets is told; the first of at most a limit, or the least."""
    sets = rules(made("tank tank, hold, sets of inputs"))
    assert sets["pump-1"].together == ("pump-2",)
    assert re.fullmatch(
        r"sends when its packet is in the set with the first value of at most \S+; decided together with pump-2",
        sets["pump-1"].sentence,
    )
    values = [name for name in sets["pump-2"].symbols if name.startswith("value of ")]
    assert values == [f"value of {links}" for links in ("no packet", "pump-1", "pump-2", "pump-1 and pump-2")]
    priced = sentences(made("tank tank, sets of links"))
    assert "in the set with the least value; decided together with pump-1" in priced[1]


@pytest.mark.parametrize(
    ("name", "told", "limits"),
    [
        ("tank tank, limits of intervals", "at the earliest 2 steps (4 s) and at the latest 4 steps (8 s)", (2, 4)),
        ("kept event-pid", "at the latest 30 steps (3 s)", (None, 30)),
        ("kind integral", "at the latest 40 steps (2 s)", (None, 40)),
    ],
)
def test_limits_of_intervals_are_those_that_the_loop_keeps(
    name: str, told: str, limits: tuple[int | None, int]
) -> None:
    """Counts of steps, in memories, locations and exclusions: no gap of a simulated path is outside them."""
    loop = problem(name).close(made(name))
    link, rule = next(iter(rules(made(name)).items()))
    assert rule.limits == (f"{told} after the last packet",)
    sent = np.flatnonzero(taciturn.simulate(loop, 3_000, seed=1).sends[link])
    gaps = np.diff(sent)
    assert gaps.max() <= limits[1]
    assert limits[0] is None or gaps.min() == limits[0]


def test_tables_tell_when_a_rule_compares() -> None:
    """States in which silence always wins, a threshold of the step, and a matrix of the step."""
    assert sentences(made("downsampled"))[0].endswith(
        ", compared at every 2nd step of silence and 1 step after a packet"
    )
    mission = rules(made("remote, 30 steps"))["actuator"]
    assert mission.when == "when η'Ψη > c"
    assert mission.symbols["Ψ"] == "matrix that changes with the step"
    assert re.fullmatch(r"\S+ to \S+, changes with the step", mission.symbols["c"])
    policy = design.periodic(SYSTEM.plant, SYSTEM.cost, every=3)
    open_ = Scheduled("clock", [[[1.0, 0.0], [0.0, 1.0]], np.zeros((2, 2)), np.zeros((2, 2))])
    rule = Trigger({"silent": Form(("estimate",), open_), "send": Form(constant=0.25)})
    steps = tuple(Decide(s.at, s.decision, rule) if isinstance(s, Decide) else s for s in policy.steps)
    changed = Policy(policy.kind, steps, policy.model, sites=policy.sites, locations=policy.locations)
    assert sentences(changed) == ["sends at every 3rd step, when |x̂| > 0.5"]


def test_timetables_are_told_by_their_steps() -> None:
    """Even and uneven ones, and those that begin differently."""
    assert sentences(made("periodic hold")) == ["sends at every 2nd step"]
    assert sentences(made("cycle hold")) == ["sends at steps 0 and 3 of every 4"]
    assert pattern_text((False, True, True, True), 2) == "1 of the first 2 steps (1), then every step"
    assert pattern_text((True, False, True, False, True, False, False), 6) == "every 2nd step from 0 to 4, then never"
    assert pattern_text([k % 7 in (1, 2) for k in range(70)], 0) == "20 of 70 steps"


def test_names_are_read_without_the_node_and_without_underscores() -> None:
    """Those of a policy of one's own, whose words are its names."""
    policy = made("tank tank, model")
    words = Words(policy)
    assert words.plain("copy_model_level-1") == "copy model"
    assert words.packet(("part_level-1",)) == "part of the estimate, 4 numbers"
    assert words.packet(("y_level-1",)) == "measurement y1"
    assert words.meaning("error_pump-1") == "input without a packet minus computed input"
    assert words.meaning("of_ones_own") == "of ones own"
    assert Words(own_policy(Trigger({"silent": Form(), "send": Form()}))).packet(("wish",)) == "wish, 1 number"


def test_a_choice_that_sends_nothing_is_told() -> None:
    """With two options by an inequality, on a timetable by its steps, and otherwise by the number of values."""
    policy = made("rollout")
    told = {step.decision: choice_of(policy, step).when for step in policy.steps if isinstance(step, Decide)}
    assert told["future"] == "the least of 6 values decides"
    assert told["begin"] == "begin at every 4th step"
    wait = made("self-triggered")
    decide = next(step for step in wait.steps if isinstance(step, Decide))
    assert re.fullmatch(r"allowed when x̂'Ψx̂ \+ \S+ > 0, otherwise shorter", choice_of(wait, decide).when)


def test_a_policy_without_steps_says_when_it_sends() -> None:
    """The optimal schedule compares with its price, of which no node knows a form."""
    optimal = taciturn.Problem(
        Plant([[1.2]], [[1.0]], [[1.0]]), Cost([[1.0]], [[1.0]]), Network(), "optimal", {"price": 2.0}
    )
    diagram = describe(optimal).diagram
    assert diagram is not None
    (link,) = diagram.links
    assert link.rule.sentence == "sends when a packet is expected to save its price of 2"
