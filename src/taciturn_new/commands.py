"""The command ``new``, which writes a problem file from prompts or from matrices in a file.

Prompts are on a terminal, or answers come from a pipe. Each answer is stored in a ``Draft`` of the problem, which
checks it against the earlier ones, before the next question. On a terminal, a wrong answer is printed and asked again;
from a pipe it is an error, since the answers after it would be read for other questions. The end of the input is an
error in both cases. With ``--yes`` every question has its default.

The order of the questions is the order in which a problem is understood: time, plant, measurement, noise, cost,
network, goal, and what the policy of this goal needs. No question follows for values in a file of ``--from``.

Modules that need numpy are imported where they are used, because ``taciturn --help`` imports this one.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TypeVar

import typer

from taciturn.cli.frame import EXAMPLE, Kind, app
from taciturn.errors import ProblemError, TaciturnError

if TYPE_CHECKING:
    from taciturn.design.kind import Kind as PolicyKind
    from taciturn.problem.matlab_and_numpy import Given

Answer = TypeVar("Answer")


class Questions:
    """Prompts that are repeated until the answer is valid; from a pipe, an invalid answer raises an error."""

    def __init__(self, yes: bool = False) -> None:
        """Check whether standard input is a terminal."""
        self.yes, self.patient = yes, sys.stdin.isatty()

    def ask(self, name: str, text: str, read: Callable[[str], Answer], default: str | None = None) -> Answer:
        """Ask a question, and return the answer as a value."""
        while True:
            given = self._answer(name, text, default)  # outside try: the end of the input is not asked again
            try:
                if not given:
                    raise ProblemError(f"{name} is missing; expected an answer, because there is no default")
                return read(given)
            except TaciturnError as error:
                self.tell(error)

    def choose(self, name: str, text: str, words: Sequence[str], default: str) -> str:
        """Ask for one of several words, and return it; the first letters are sufficient.

        Raises:
            ProblemError: as for ``ask``, or the answer is not one of the words.
        """

        def read(answer: str) -> str:
            meant = [word for word in words if answer and word.startswith(answer.lower())]
            if len(meant) != 1:
                raise ProblemError(f"{name} is {answer!r}; expected one of {', '.join(words)}")
            return meant[0]

        return self.ask(name, f"{text} ({', '.join(words)})", read, default)

    def tell(self, error: TaciturnError) -> None:
        """Print an error before the question is repeated; raise it if the input is a pipe or there are no prompts."""
        if self.yes:
            raise error
        if not self.patient:
            remedy = "no file was written; in scripts, give matrices with --from, or write the file yourself"
            raise ProblemError(f"{error}; {remedy}") from error
        self.say(str(error))

    def say(self, text: str) -> None:
        """Print an indented message for the user."""
        if not self.yes:
            typer.echo(f"  {text}")

    def _answer(self, name: str, text: str, default: str | None) -> str:
        """Return the answer; a matrix may take several lines until its brackets are closed."""
        if self.yes:
            if default is None:
                raise ProblemError(f"{name} has no default; expected an answer: run the command without --yes")
            return default
        given = self._line(name, f"{text} [{default}]: " if default is not None else f"{text}: ")
        while given.count("[") > given.count("]"):
            given += "\n" + self._line(name, "  … ")
        return given or default or ""

    def _line(self, name: str, prompt: str) -> str:
        try:
            given = input(prompt).strip()
        except EOFError:
            typer.echo()
            raise ProblemError(
                f"the input ends before {name} is given; expected one more answer; no file was written"
            ) from None
        except UnicodeDecodeError as error:
            raise ProblemError(
                f"the answer to {name} is not UTF-8 text ({error.reason}); expected UTF-8 text"
            ) from None
        if not self.patient:
            typer.echo(given)  # a terminal shows the answer itself
        return given


GAINS = "kp, or kp ki, or kp ki kd and the time constant of the derivative's filter"
SQUARE = "a number (times the identity), a diagonal, or a matrix"


@app.command(epilog=EXAMPLE + "taciturn new mine.toml --kind lqg")
def new(
    out: Annotated[Path, typer.Argument(metavar="[OUT.toml]", help="File to write.")] = Path("problem.toml"),
    source: Annotated[
        Path | None,
        typer.Option("--from", metavar="FILE", help="Read matrices from a .mat or .npz file with A, B, C, W, …"),
    ] = None,
    kind: Kind = None,
    dt: Annotated[
        float | None, typer.Option(help="Sampling period of the model in seconds; 0: continuous time.")
    ] = None,
    yes: Annotated[bool, typer.Option("--yes", help="With --from: use the defaults without prompts.")] = False,
) -> None:
    """Write a commented problem file, from prompts or from matrices in a file.

    The order of the prompts is: continuous or discrete time, and dt; A; B; whether the whole state is measured, or C
    and V; W; Q; R; the network and its packet dropouts, if no kind is given; the goal, or a policy kind; the parameters
    of the policy. In place of Q and R, you may enter the gains of a PID controller to keep; links are then ideal. If
    answers come from a pipe, the first invalid answer is an error. Scripts should use --from.
    """
    from taciturn.extend import check_format, number, remark, write_whole
    from taciturn.problem.matlab_and_numpy import read_given

    def refuse_to_overwrite() -> None:
        if out.exists():
            raise ProblemError(f"{out} already exists; expected the name of a new file: files are not overwritten")

    check_format(out, (".toml",), "problem file")
    refuse_to_overwrite()
    if yes and source is None:
        raise ProblemError("--yes is given without --from; expected both options, or neither of them")
    if dt is not None:
        number("--dt", dt, 0.0, closed=True)
    given = None if source is None else read_given(source)
    with remark("no file was written"):
        text = _Interview(Questions(yes), given, source, out.name).complete(dt, kind)
    refuse_to_overwrite()
    write_whole(out, text.encode())
    if given is not None and "D" in given.arrays:
        from taciturn.model.plant import FED

        typer.echo(f"D in {source} is read as a direct feedthrough: {FED}")
    if given is not None and given.ignored:
        typer.echo(f"ignored in {source}: {', '.join(given.ignored)}")
    typer.echo(f"written: {out}\nnext: taciturn show {out}, taciturn evaluate {out}")


class _Interview:
    """Prompts for the values that are missing in a draft of a problem file."""

    def __init__(self, questions: Questions, given: Given | None, source: Path | None, name: str) -> None:
        """Start with an empty draft."""
        from taciturn_new.draft import Draft

        self.questions, self.given, self.source, self.name = questions, given, source, name
        self.draft = Draft()

    def complete(self, dt: float | None, kind: str | None) -> str:
        """Ask for all missing values, and return the text of the problem file."""
        from taciturn.problem.parameters import find_kind
        from taciturn_new.draft import over_losses

        questions = self.questions
        chosen = None if kind is None else find_kind(kind, "the kind")
        if questions.yes:
            self._expect_all(dt)
        self._ask_time(dt)
        self._ask_plant()
        self._ask_cost()
        try:
            if chosen is not None:
                self.draft.expect_fit(chosen)
        except TaciturnError as error:
            self.questions.tell(error)
            chosen = None
        if chosen is not None and chosen.for_dropouts:
            self._ask_network("udp", [chosen])
        elif chosen is None and not questions.yes and not self.draft.controller:
            self._ask_network("ideal", over_losses())
        while True:
            policy = self._ask_policy(chosen)
            try:
                return self.draft.write(policy, self.name)
            except TaciturnError as error:
                self.questions.tell(error)
                chosen = None
                if self.draft.network:  # its losses may be too high for any policy
                    self._ask_network("ideal", over_losses())

    def _expect_all(self, dt: float | None) -> None:
        """Raise an error if the file lacks a value without default."""
        assert self.given is not None
        missing = [key for key in ("A", "B", "W", "Q", "R") if key not in self.given.arrays]
        if dt is None and self.given.dt is None:
            missing.append("dt (or Ts; 0 for continuous time)")
        if missing:
            raise ProblemError(
                f"{self.source} lacks {', '.join(missing)}; expected these values for --yes; omit --yes to be prompted"
            )

    def _ask_time(self, dt: float | None) -> None:
        from taciturn.extend import number
        from taciturn.problem.settings import parse_number

        told = None if self.given is None else self.given.dt
        if dt is not None and told is not None and dt != told:
            raise ProblemError(
                f"--dt is {dt:g}, but the time base in {self.source} is {told:g}; expected the same value, or no --dt"
            )
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
        self._take("A", f"A, the dynamics per {per}, for example [1 2; 3 4]")
        if self._has("E"):
            self._take("E", "E, the matrix of the derivative, or of the next state")
        self._take("B", "B, the input matrix")
        whole = not self._has("C") and not self._has("V") and not self._has("D")
        if whole and not self.questions.yes:
            question = "Is the whole state measured without noise?"
            whole = self.questions.choose("what is measured", question, ("yes", "no"), "yes") == "yes"
        if not whole:
            if self._has("V") and not self._has("C"):  # y = x + v
                draft.measure_all()
            else:
                self._take("C", "C, the measurements y = Cx + v")
            if self._has("D"):
                self._take("D", "D")
            self._take(
                "V",
                f"V, the covariance of v per sample: {SQUARE}; or ± and the deviation of each output, ± 0.1 0.2",
                "0",
            )
            if not draft.plant["V"].any():
                draft.drop("V")
        what = "intensity per second" if draft.continuous else "covariance per step"
        amplitudes = "or ± and the deviation of each state, or inputs ± and that of noise at each input, inputs ± 0.3"
        after = "after a second" if draft.continuous else "in a step"
        self._take("W", f"W, the process noise, {what}: {SQUARE}; {amplitudes}, {after}", "1")

    def _ask_cost(self) -> None:
        pid = f"; or pid and its {GAINS}, to keep this controller, and weights by its present loop"
        kept = pid if self.draft.counts == (1, 1) else ""
        self._take("Q", f"Q, the state weight, x'Qx: {SQUARE}{kept}", "1")
        if self.draft.controller:
            return
        self._take("R", f"R, the input weight, u'Ru: {SQUARE}", "1")
        if self._has("N"):
            self._take("N", "N")

    def _ask_network(self, default: str, kinds: Sequence[PolicyKind]) -> None:
        """Ask for the network; packets may be dropped if one of these kinds fits the plant and the cost."""
        from taciturn.extend import number
        from taciturn.problem.settings import parse_number

        def read_protocol(text: str) -> str:
            word = text.lower()
            if word not in ("ideal", "tcp", "udp"):
                raise ProblemError(f"the network is {text!r}; expected ideal, tcp or udp")
            if word != "ideal" and not any(self.draft.fits(kind) for kind in kinds):
                needs = " or ".join(f"{kind.name}, requires {kind.requires}" for kind in kinds)
                raise ProblemError(f"the network is {word}, but the policy for this network, {needs}; expected ideal")
            return word

        ask = self.questions.ask
        question = "Network: ideal, tcp (dropouts, with acknowledgement) or udp (dropouts, without acknowledgement)"
        protocol = ask("the network", question, read_protocol, default)
        self.draft.network.clear()
        if protocol == "ideal":
            return
        self.draft.network["protocol"] = protocol
        shares = {"actuator_loss": ("packets to the actuator", "0.1"), "sensor_loss": ("measurements", "0")}
        for name, (what, usual) in shares.items():

            def read(text: str, name: str = name) -> float:
                return number(name, parse_number(text), 0.0, 1.0, closed=True)

            self.draft.network[name] = ask(name, f"Share of the {what} that is dropped", read, usual)

    def _ask_policy(self, kind: PolicyKind | None) -> dict[str, Any]:
        """Ask for the goal, and for the parameters of its policy."""
        from taciturn.problem.parameters import check_parameter
        from taciturn.problem.settings import parse_number
        from taciturn_new.draft import needed_parameters, over_losses, suggest_value

        if kind is None and self.draft.network:
            kind = next(kind for kind in over_losses() if self.draft.fits(kind))
            self.questions.say(f"the policy for this network is {kind.name}")
        chosen = kind or self._ask_kind()
        policy: dict[str, Any] = {"kind": chosen.name}
        plant, cost = self.draft.made_plant(), self.draft.made_cost()
        needed = needed_parameters(chosen, self.draft.continuous)
        for name in needed:
            usual = suggest_value(chosen, name, plant, cost, policy.get("period"))

            def read(text: str, name: str = name) -> Any:
                return check_parameter(chosen, name, parse_number(text))

            question = f"{name}: {chosen.notes.get(name, '')}"
            policy[name] = self.questions.ask(name, question, read, None if usual is None else f"{usual:g}")
        kept = chosen.arguments["controller"] if chosen.keeps_controller else None
        if kept is not None and kept.default is kept.empty and not self.draft.controller:
            self.questions.ask("the controller", f"PID controller: {GAINS}", self.draft.keep_pid)
        return policy | {name: usual for name, usual in chosen.usual.items() if name not in (*needed, *chosen.asked)}

    def _ask_kind(self) -> PolicyKind:
        from taciturn.problem.parameters import find_kind
        from taciturn_new.draft import offered_kinds

        offered, wrong = offered_kinds()
        for sentence in wrong:
            self.questions.say(sentence)
        fitting = [kind for kind in offered if self.draft.fits(kind)]
        for i, kind in enumerate(fitting):
            self.questions.say(f"{i + 1}  {kind.name:14s} {kind.goal}")

        def read(text: str) -> PolicyKind:
            if not text.isdecimal():
                kind = find_kind(text, "the kind")
                self.draft.expect_fit(kind)
                return kind
            if not 1 <= int(text) <= len(fitting):
                raise ProblemError(f"the goal is {text}; expected a number from 1 to {len(fitting)}, or a policy kind")
            return fitting[int(text) - 1]

        return self.questions.ask("the goal", "What is the goal? A number, or a policy kind", read, "1")

    def _has(self, key: str) -> bool:
        return self.given is not None and key in self.given.arrays

    def _take(self, key: str, question: str, usual: str | None = None) -> None:
        """Take a matrix from the file, or prompt for it."""
        from taciturn_new.matrices import parse_matrix, parse_noise

        if self.given is None or key not in self.given.arrays:

            def keep(text: str) -> None:
                if key == "Q" and text.lower().startswith("pid"):
                    self.draft.keep_pid(text[len("pid") :])
                    return
                stated = parse_noise(key, text, self.draft.plant["B"]) if key in "VW" else parse_matrix(key, text)
                self.draft.keep(key, stated)

            self.questions.ask(key, question, keep, usual)
            return
        try:
            self.draft.keep(key, self.given.arrays[key])
        except TaciturnError as error:
            raise ProblemError(f"{self.source}: {error}") from None
