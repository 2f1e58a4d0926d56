"""The questions of ``taciturn new``, in the order in which a control engineer describes a problem.

Time, plant, measurements, noise, the controller, further parts (``parts``), the goal, and what the policy of this goal
needs. Signals are numbered from 1. Questions about noise accept standard deviations, and those about weights acceptable
sizes of outputs and inputs. Each answer is stored in a ``Draft``, which checks it against the earlier ones. No question
follows for values in a file of ``--from``.
"""

from __future__ import annotations

import os.path
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from taciturn.errors import ProblemError, TaciturnError
from taciturn.extend import Array, number_of
from taciturn.problem.parameters import check_parameter, find_kind
from taciturn.problem.settings import parse_number
from taciturn_new.draft import Draft, needed_parameters, offered_kinds, suggest_value
from taciturn_new.matrices import parse_indices, parse_input_noise, parse_matrix, parse_noise, parse_weight
from taciturn_new.parts import Parts
from taciturn_new.readers import ALL, a_number, matrix

if TYPE_CHECKING:
    from taciturn.design.kind import Kind
    from taciturn.problem.matlab_and_numpy import Given
    from taciturn_new.questions import Questions

GAINS = "kp, or kp ki, or kp ki kd and the time constant of the derivative's filter"
OWN = "pid", "gain", "matrices", "file"  # forms of a controller to keep
# parameters of policies in plain words; for others, the note of the policy kind
ASKED = {
    "theta": "theta: extra cost that is allowed, as a share of the cost of sending every sample; 0.1 is 10 %",
    "period": "period: seconds between two samples",
    "price": "price: cost of a packet, in the units of the cost",
}


class Interview:
    """Questions about all values that are still missing in the draft of a problem file."""

    def __init__(self, questions: Questions, given: Given | None, source: Path | None, path: Path) -> None:
        """Start with an empty draft."""
        self.questions, self.given, self.source, self.path = questions, given, source, path
        self.draft = Draft()
        self.parts = Parts(questions, self.draft, path.parent, self._ask_estimated_noise)

    def complete(self, dt: float | None, kind: str | None) -> str:
        """Ask for all values that are missing, and return the text of the complete problem file."""
        questions, chosen = self.questions, None if kind is None else find_kind(kind, "the kind")
        if questions.yes:
            self._expect_all(dt)
        questions.begin("Plant")
        self._ask_time(dt)
        self._ask_plant()
        questions.begin("Measurements and noise")
        self._ask_measurements()
        self._ask_noise()
        questions.begin("Controller")
        self._ask_controller()
        try:
            if chosen is not None:
                self.draft.expect_fit(chosen)
        except TaciturnError as error:
            questions.tell(error)
            chosen = None
        if not questions.yes:
            self.parts.ask()
        while True:
            questions.begin("Policy")
            policy = self._ask_policy(chosen)
            try:
                return self.draft.write(policy, self.path)
            except TaciturnError as error:
                questions.tell(error)
                chosen = None

    def _expect_all(self, dt: float | None) -> None:
        """Raise an error if the file lacks a value without default."""
        assert self.given is not None
        missing = [key for key in ("A", "B", "W", "Q", "R") if key not in self.given.arrays]
        if dt is None and self.given.dt is None:
            missing.append("dt (or Ts; 0 for continuous time)")
        if missing:
            raise ProblemError(
                f"the file {self.source} lacks {', '.join(missing)}; expected these values in the file, since --yes "
                "asks no questions; omit --yes to enter them"
            )

    def _ask_time(self, dt: float | None) -> None:
        told = None if self.given is None else self.given.dt
        if dt is not None and told is not None and dt != told:
            raise ProblemError(
                f"--dt is {dt:g}, but the time base in {self.source} is {told:g}; expected the same value, or no --dt"
            )
        step = told if dt is None else dt
        if step is None:
            words, step = ("continuous", "discrete"), 0.0
            question = "Is the model continuous in time, dx/dt = A x + B u, or discrete, x⁺ = A x + B u?"
            why = "A differential equation is continuous. A model that was sampled or identified from data is discrete."
            if self.questions.choose("the time base", question, words, "continuous", why=why) == "discrete":
                step = self.questions.ask("dt", "Seconds per step", a_number("dt", 0.0), "1", example="0.1")
        self.draft.dt = step

    def _ask_plant(self) -> None:
        per = "second" if self.draft.continuous else "step"
        why = "Entry (i, j) is the effect of state j on state i. A row ends with ; in MATLAB, and is a list in Python."
        self._take("A", f"A, the dynamics per {per}: one row per state", example="[0 1; 0 -0.5]", why=why)
        if self._has("E"):
            self._take("E", "E, the matrix of the derivative, or of the next state")
        states = len(self.draft.plant["A"])
        self._take(
            "B",
            f"B, the effect of the inputs: {number_of(states, 'row')}, one column per input",
            example=f"[{'; '.join([*['0'] * (states - 1), '1'])}]",
            why="Entry (i, j) is the effect of input j on state i.",
        )

    def _ask_measurements(self) -> None:
        draft, states = self.draft, len(self.draft.plant["A"])
        if not any(map(self._has, "CVD")):
            if self.questions.yes:
                return

            def read(text: str) -> None:
                if "[" in text:
                    draft.keep("C", parse_matrix("C", text))
                elif text.lower() == ALL:
                    draft.measure_all()
                else:
                    draft.keep("C", np.eye(states)[parse_indices("the measured signals", text, states)])

            self.questions.ask(
                "the measured signals",
                "Measured signals: all states, the numbers of some, or in brackets the matrix C of y = C x",
                read,
                ALL,
                example=f"1, or [{' '.join(['1', *['0'] * (states - 1)])}]",
                why="A sensor that measures the sum of two states has the row [1 1] in C.",
            )
        elif self._has("C") or self._has("D"):
            self._take("C", "C, the measurements y = C x")
        else:  # y = x + v
            draft.measure_all()
        if self._has("D"):
            self._take("D", "D")
        self._ask_measurement_noise("0")

    def _ask_measurement_noise(self, usual: str) -> None:
        """Ask for the noise of measurements; all states without noise are a measurement of the full state."""
        draft, outputs = self.draft, len(self.draft.plant["C"])
        self._take(
            "V",
            f"Noise of each measurement, a standard deviation in its unit: {_how_many(outputs)}; 0 is exact",
            usual,
            example=" ".join(["0.1", *["0.2"] * (min(outputs, 3) - 1)]),
            why="The standard deviation is the typical error of a sample. In brackets: the covariance matrix V.",
        )
        if not draft.plant["V"].any():
            draft.drop("V")
            if np.array_equal(draft.plant["C"], np.eye(len(draft.plant["A"]))):
                draft.drop("C")

    def _ask_estimated_noise(self) -> None:
        """Ask for the noise of measurements from which disturbances or set-points are estimated."""
        if "C" not in self.draft.plant:
            self.draft.measure_all()
        self._ask_measurement_noise("0.1")

    def _ask_noise(self) -> None:
        after, kind = ("after a second", "intensity") if self.draft.continuous else ("in a step", "covariance")
        self._take(
            "W",
            f"Noise that acts on the states, a standard deviation {after}: {_how_many(len(self.draft.plant['A']))}; "
            "with the word inputs before it, noise that adds to the inputs",
            "1",
            example="0.1, or inputs 0.3",
            why=f"Unknown influences, such as gusts, and errors of the model. In brackets: the {kind} matrix W.",
        )

    def _ask_controller(self) -> None:
        """Ask for the controller to keep, or for the weights of LQG."""
        stated = all(map(self._has, "QR"))
        kept = "lqg"
        if not self.questions.yes and not stated:
            kept = self.questions.choose(
                "the controller",
                f"Controller: lqg is designed for you; {', '.join(OWN)} keep one of yours",
                ("lqg", *OWN),
                "lqg",
                why="gain is u = −K y. The cost of a controller that you keep weighs its present variances equally.",
            )
        if kept == "lqg":
            self._ask_weights()
        elif kept == "pid":
            self._ask_pid()
        elif kept == "gain":
            self._keep_matrix("D", "K", "Gain K of u = −K y: one row per input, one column per output", "[1.5]")
        elif kept == "matrices":
            self.questions.say("xc⁺ = A xc + B y in each step, u = −(C xc + D y)")
            for name, example in (("A", "[1]"), ("B", "[0.1]"), ("C", "[0.2]"), ("D", "[1.5]")):
                what = f"{name} of the controller"
                self._keep_matrix(name, what, what, example)
        else:
            text = "MATLAB or NumPy file with A, B, C, D and Ts of the controller"
            self.questions.ask("the file", text, self._keep_file, example="controller.mat")

    def _keep_matrix(self, key: str, name: str, text: str, example: str) -> None:
        self.draft.controller[key] = self.questions.ask(name, text, matrix(name), example=example)

    def _keep_file(self, text: str) -> None:
        from taciturn.problem.matlab_and_numpy import read_controller

        read_controller(text)
        self.draft.controller["file"] = os.path.relpath(text, self.path.parent)

    def _ask_weights(self) -> None:
        plant, per = self.draft.plant, "second" if self.draft.continuous else "step"
        why = (
            f"The cost per {per} is the sum of squares of outputs and inputs, each divided by its acceptable size: a "
            "deviation of this size costs 1. In brackets: the weights of x'Qx + u'Ru."
        )
        sizes = {"Q": ("output", len(self._seen)), "R": ("input", plant["B"].shape[1])}
        for key, (signal, size) in sizes.items():
            text = f"Acceptable size of each {signal}, in its unit: {_how_many(size)}; or the weight {key} in brackets"
            self._take(key, text, "1", example="0.5", why=why)
        if self._has("N"):
            self._take("N", "N")

    @property
    def _seen(self) -> Array:
        """The output matrix."""
        return self.draft.plant.get("C", np.eye(len(self.draft.plant["A"])))

    def _ask_pid(self) -> None:
        """Ask for a PID controller, or for one for each input."""
        ask, draft = self.questions.ask, self.draft
        inputs, outputs = draft.counts
        why = "u = kp e + ki ∫e dt + kd de/dt with e = set-point − output; ki per second, kd and filter in seconds."
        several = (inputs, outputs) != (1, 1)
        for i in range(inputs):
            name, place = "the controller", None
            if several:
                name = f"the controller of input {i + 1}"
                at = ask(
                    f"the output of {name}",
                    f"Number of the output that {name} reads",
                    self._one_output,
                    str(min(i + 1, outputs)),
                )
                place = {"input": i + 1, "output": at + 1}
            ask(name, f"PID gains{name[14:]}: {GAINS}", self._keep_pid(place), example="1.2 0.15", why=why)

    def _one_output(self, text: str) -> int:
        found = parse_indices("the output", text, self.draft.counts[1])
        if len(found) > 1:
            raise ProblemError(f"the output is {text!r}; expected one number")
        return found[0]

    def _keep_pid(self, place: dict[str, int] | None) -> Callable[[str], None]:
        return lambda text: self.draft.keep_pid(text, place)

    def _ask_policy(self, kind: Kind | None) -> dict[str, Any]:
        """Ask for the goal, and for the parameters of its policy."""
        chosen = kind or self._ask_kind()
        policy: dict[str, Any] = {}
        plant, cost = self.draft.made_plant(), self.draft.made_cost()
        for name in needed_parameters(chosen, self.draft.continuous):
            usual = suggest_value(chosen, name, plant, cost, policy.get("period"))

            def read(text: str, name: str = name) -> Any:
                return check_parameter(chosen, name, parse_number(text))

            note = chosen.notes.get(name, "")
            question = ASKED.get(name, f"{name}: {note}")
            policy[name] = self.questions.ask(name, question, read, None if usual is None else f"{usual:g}", why=note)
        kept = chosen.arguments["controller"] if chosen.keeps_controller else None
        if kept is not None and kept.default is kept.empty and not self.draft.controller:
            self._ask_pid()
        return self.draft.completed(chosen, policy)

    def _ask_kind(self) -> Kind:
        offered, wrong = offered_kinds()
        for sentence in wrong:
            self.questions.say(sentence)
        while not (fitting := [kind for kind in offered if self.draft.fits(kind)]):
            meant = next(kind for kind in offered if self.draft.nodes or kind.nodes != "any")
            self.questions.tell(ProblemError(f"no policy accepts these parts: {self.draft.refusal(meant)}"))
            self.parts.ask()
        if self.draft.loses:
            fitting.sort(key=lambda kind: not kind.for_dropouts)
        for i, kind in enumerate(fitting):
            self.questions.say(kind.goal, f"{i + 1}  {kind.name:14s} ")

        def read(text: str) -> Kind:
            if not text.isdecimal():
                kind = find_kind(text, "the kind")
                self.draft.expect_fit(kind)
                return kind
            if not 1 <= int(text) <= len(fitting):
                raise ProblemError(f"the goal is {text}; expected a number from 1 to {len(fitting)}, or a policy kind")
            return fitting[int(text) - 1]

        why = "Each goal has a policy that decides when a packet is sent. taciturn compare ranks several."
        return self.questions.ask("the goal", "What is the goal? A number, or a policy kind", read, "1", why=why)

    def _has(self, key: str) -> bool:
        return self.given is not None and key in self.given.arrays

    def _take(self, key: str, question: str, usual: str | None = None, *, example: str = "", why: str = "") -> None:
        """Take a matrix from the file, or ask for it."""
        if self.given is None or key not in self.given.arrays:
            self.questions.ask(
                key,
                question,
                lambda text: self.draft.keep(key, self._parsed(key, text)),
                usual,
                example=example,
                why=why,
            )
            return
        try:
            self.draft.keep(key, self.given.arrays[key])
        except TaciturnError as error:
            raise ProblemError(f"{self.source}: {error}") from None

    def _parsed(self, key: str, text: str) -> Array:
        """Return a matrix from an answer: a covariance or a weight may be stated by sizes."""
        plant = self.draft.plant
        if key == "V":
            return parse_noise(key, text, len(plant["C"]), "output")
        if key == "W":
            at_inputs = parse_input_noise(text, plant["B"])
            return parse_noise(key, text, len(plant["A"]), "state") if at_inputs is None else at_inputs
        if key == "Q":
            return parse_weight(key, text, self._seen, "output")
        if key == "R":
            return parse_weight(key, text, np.eye(plant["B"].shape[1]), "input")
        return parse_matrix(key, text)


def _how_many(size: int) -> str:
    return "one number" if size == 1 else f"one number, or {size} numbers"
