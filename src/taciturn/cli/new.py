"""The command that writes a problem file, by asking or from matrices in a file."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from taciturn._grid import parse_number
from taciturn.cli.frame import Kind, app
from taciturn.cli.questions import Questions

if TYPE_CHECKING:
    from taciturn.problem.given import Given

GOALS = {
    "lqg": "a margin on the cost: at most 1 + θ times that of sending always",
    "near-optimal": "a price on every send: cost + price × rate, nearly the least there is",
    "consistent": "to beat a clock: never worse than periodic control that sends as often",
    "remote-lqg": "a sensor that is asked: queries by a schedule, inputs where needed",
    "send-on-delta": "a sensor as simple as can be: it sends when an output has moved by Δ",
    "lossy-lqg": "a link that loses packets: a price on every send, and what is lost is reckoned with",
    "excess": "the margin of lqg with less traffic, the actuator predicting: in doubt, this one",
}
SQUARE = "a number (times the identity), a diagonal, or a matrix"


@app.command(epilog="Example: taciturn new mine.toml --from plant.mat --kind lqg")
def new(
    out: Annotated[Path, typer.Argument(metavar="[OUT.toml]", help="The file to be written.")] = Path("problem.toml"),
    source: Annotated[
        Path | None, typer.Option("--from", metavar="FILE", help="Matrices: a .mat or .npz file with A, B, C, W, …")
    ] = None,
    kind: Kind = None,
    dt: Annotated[float | None, typer.Option(help="Seconds per step of the model; 0: continuous in time.")] = None,
    yes: Annotated[bool, typer.Option("--yes", help="With --from: ask nothing, take what is usual.")] = False,
) -> None:
    """Write a problem file with comments, by asking what is needed, or from matrices in a file.

    Asked for, in this order, where it is not given: continuous or discrete, and dt; A; B; whether the whole state is
    measured, or C and V; W; Q; R; the network, where no kind is given, and what it loses; what matters, or a kind of
    policy; its parameters. Answers from a pipe end at the first that does not fit: for scripts there is --from.
    """
    from taciturn._arrays import number
    from taciturn._figure import check_format
    from taciturn._files import write_whole
    from taciturn.errors import ProblemError
    from taciturn.problem.given import read_given

    def refuse_to_overwrite() -> None:
        if out.exists():
            raise ProblemError(f"{out} is there; expected the name of a file that is not, as nothing is overwritten")

    check_format(out, (".toml",), "problem file")
    refuse_to_overwrite()
    if yes and source is None:
        raise ProblemError("--yes is given without --from; expected both, or neither")
    if dt is not None:
        number("--dt", dt, 0.0, closed=True)
    given = None if source is None else read_given(source)
    try:
        text = _Interview(Questions(yes), given, source, out.name).complete(dt, kind)
    except KeyboardInterrupt:
        print("\ntaciturn: interrupted; nothing is written", file=sys.stderr)
        raise
    refuse_to_overwrite()
    write_whole(out, text.encode())
    if given is not None and given.ignored:
        typer.echo(f"ignored in {source}: {', '.join(given.ignored)}")
    typer.echo(f"written: {out}\nnext: taciturn show {out}, taciturn evaluate {out}")


class _Interview:
    """Asks for what a draft lacks.

    Args:
        questions: who asks.
        given: what a file says.
        source: that file.
        name: of the file that is written.
    """

    def __init__(self, questions: Questions, given: Given | None, source: Path | None, name: str) -> None:
        """Begin with nothing."""
        from taciturn.problem.draft import Draft

        self.questions, self.given, self.source, self.name = questions, given, source, name
        self.draft = Draft()

    def complete(self, dt: float | None, kind: str | None) -> str:
        """Ask for all that is not given, and return the text of the file."""
        from taciturn.errors import TaciturnError

        questions = self.questions
        if kind is not None:
            _expect_kind(kind)
        if questions.yes:
            self._expect_all(dt)
        self._ask_time(dt)
        self._ask_plant()
        self._ask_cost()
        try:
            self.draft.expect_fit(kind or "")
        except TaciturnError as error:
            self.questions.tell(error)
            kind = None
        if kind == "lossy-lqg" or (kind is None and not questions.yes):
            self._ask_network("ideal" if kind is None else "udp")
        while True:
            policy = self._ask_policy(kind)
            try:
                return self.draft.write(policy, self.name)
            except TaciturnError as error:
                self.questions.tell(error)
                kind = None
                if self.draft.network:  # which may lose more than any policy bears
                    self._ask_network("ideal")

    def _expect_all(self, dt: float | None) -> None:
        """Refuse a file that lacks what has no usual value."""
        from taciturn.errors import ProblemError

        assert self.given is not None
        missing = [key for key in ("A", "B", "W", "Q", "R") if key not in self.given.arrays]
        if dt is None and self.given.dt is None:
            missing.append("dt (or Ts; 0 of a continuous plant)")
        if missing:
            raise ProblemError(
                f"{self.source} lacks {', '.join(missing)}; expected them there with --yes: leave it away to be asked"
            )

    def _ask_time(self, dt: float | None) -> None:
        from taciturn._arrays import number
        from taciturn.errors import ProblemError

        told = None if self.given is None else self.given.dt
        if dt is not None and told is not None and dt != told:
            raise ProblemError(f"--dt is {dt:g}, and the time base in {self.source} is {told:g}; expected one of them")
        step = told if dt is None else dt
        if step is None:
            words, step = ("continuous", "discrete"), 0.0
            question = "Is the model continuous in time, dx/dt = Ax + Bu, or discrete, x⁺ = Ax + Bu?"
            if self.questions.choose("the time base", question, words, "continuous") == "discrete":
                read: Callable[[str], float] = lambda text: number("dt", parse_number(text), 0.0)  # noqa: E731
                step = self.questions.ask("dt", "Seconds per step", read, "1")
        self.draft.dt = step

    def _ask_plant(self) -> None:
        draft, per = self.draft, "second" if self.draft.continuous else "step"
        self._take("A", f"A, the dynamics per {per}, as [1 2; 3 4]")
        self._take("B", "B, what the inputs do")
        whole = not self._has("C") and not self._has("V")
        if whole and not self.questions.yes:
            question = "Is the whole state measured, exactly?"
            whole = self.questions.choose("what is measured", question, ("yes", "no"), "yes") == "yes"
        if not whole:
            if self._has("V") and not self._has("C"):  # y = x + v
                draft.measure_all()
            else:
                self._take("C", "C, what is measured, y = Cx + v")
            self._take("V", f"V, the covariance of v in a sample: {SQUARE}", "0")
            if not draft.plant["V"].any():
                draft.drop("V")
        what = "intensity per second" if draft.continuous else "covariance per step"
        self._take("W", f"W, the noise on the states, {what}: {SQUARE}", "1")

    def _ask_cost(self) -> None:
        self._take("Q", f"Q, what states cost, x'Qx: {SQUARE}", "1")
        self._take("R", f"R, what inputs cost, u'Ru: {SQUARE}", "1")
        if self._has("N"):
            self._take("N", "N")

    def _ask_network(self, default: str) -> None:
        """Ask for the links; what loses packets is for one kind of policy."""
        from taciturn._arrays import number
        from taciturn.errors import ProblemError

        def read_protocol(text: str) -> str:
            word = text.lower()
            if word not in ("ideal", "tcp", "udp"):
                raise ProblemError(f"the network is {text!r}; expected ideal, tcp or udp")
            if word != "ideal" and not self.draft.fits("lossy-lqg"):
                raise ProblemError(
                    f"the network is {word}, and losses are reckoned with where the model is discrete in time, its "
                    "whole state is measured and N is 0; expected ideal"
                )
            return word

        ask = self.questions.ask
        question = "Network: ideal, tcp (losses, the sender is told) or udp (losses, nobody is told)"
        protocol = ask("the network", question, read_protocol, default)
        self.draft.network.clear()
        if protocol == "ideal":
            return
        self.draft.network["protocol"] = protocol
        shares = {"actuator_loss": ("packets to the actuator", "0.1"), "sensor_loss": ("measurements", "0")}
        for name, (what, usual) in shares.items():

            def read(text: str, name: str = name) -> float:
                return number(name, parse_number(text), 0.0, 1.0, closed=True)

            self.draft.network[name] = ask(name, f"Share of the {what} that is lost", read, usual)

    def _ask_policy(self, kind: str | None) -> dict[str, Any]:
        """Ask what matters, and what the policy for that must be told."""
        from taciturn.problem.parameters import check_parameter
        from taciturn.problem.suggested import needed_parameters, suggest_value
        from taciturn.problem.written import parameter_notes

        if kind is None and self.draft.network:
            self.questions.say("lossy-lqg is the policy for such a network")
            kind = "lossy-lqg"
        chosen = kind or self._ask_kind()
        policy: dict[str, Any] = {"kind": chosen}
        plant, cost, notes = self.draft.made_plant(), self.draft.made_cost(), parameter_notes(chosen)
        for name in needed_parameters(chosen, self.draft.continuous):
            usual = suggest_value(name, plant, cost, policy.get("period"))

            def read(text: str, name: str = name) -> Any:
                return check_parameter(chosen, name, parse_number(text))

            question = f"{name}: {notes.get(name, '')}"
            policy[name] = self.questions.ask(name, question, read, None if usual is None else f"{usual:g}")
        if chosen == "excess":  # which sends less where the actuator predicts than where it holds
            policy["actuation"] = "model"
        return policy

    def _ask_kind(self) -> str:
        from taciturn.errors import ProblemError

        fitting = [kind for kind in GOALS if self.draft.fits(kind)]
        for i, kind in enumerate(fitting):
            self.questions.say(f"{i + 1}  {kind:14s} {GOALS[kind]}")

        def read(text: str) -> str:
            if not text.isdecimal():
                self.draft.expect_fit(_expect_kind(text))
                return text
            if not 1 <= int(text) <= len(fitting):
                raise ProblemError(f"what matters is {text}; expected a number from 1 to {len(fitting)}, or a kind")
            return fitting[int(text) - 1]

        return self.questions.ask("what matters", "What matters? A number, or any kind of policy", read, "1")

    def _has(self, key: str) -> bool:
        return self.given is not None and key in self.given.arrays

    def _take(self, key: str, question: str, usual: str | None = None) -> None:
        """Take a matrix from the file, or ask for it."""
        from taciturn.errors import ProblemError, TaciturnError
        from taciturn.problem.matrices import parse_matrix

        if self.given is None or key not in self.given.arrays:
            self.questions.ask(key, question, lambda text: self.draft.keep(key, parse_matrix(key, text)), usual)
            return
        try:
            self.draft.keep(key, self.given.arrays[key])
        except TaciturnError as error:
            raise ProblemError(f"{self.source}: {error}") from None


def _expect_kind(kind: str) -> str:
    from taciturn.design.catalogue import CATALOGUE
    from taciturn.errors import ProblemError
    from taciturn.problem.tables import suggest

    if kind not in CATALOGUE:
        near = suggest(kind, list(CATALOGUE))
        raise ProblemError(f"the kind is {kind!r}; expected one of {', '.join(CATALOGUE)}{near}")
    return kind
