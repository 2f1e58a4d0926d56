"""The command ``taciturn new``, which writes a problem file from answers to questions or from a file of matrices.

Modules that need numpy are imported where they are used, because ``taciturn --help`` imports this one.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from taciturn.cli.frame import EXAMPLE, Kind, app
from taciturn.errors import ProblemError, TaciturnError

if TYPE_CHECKING:
    from taciturn.problem.matlab_and_numpy import Given
    from taciturn_new.questions import Questions

CHEAP = 3.0  # seconds that the first evaluation may take
STEPS = 2_000_000  # simulated steps of the first evaluation, if it is not exact
LARGEST = 2**20  # bytes of a file of answers
HELLO = "Enter takes the value in [brackets], ? explains a question, back returns to the last one, Ctrl-C ends."


@app.command(epilog=EXAMPLE + "taciturn new mine.toml --kind lqg")
def new(
    out: Annotated[Path, typer.Argument(metavar="[OUT.toml]", help="File to write.")] = Path("problem.toml"),
    source: Annotated[
        Path | None,
        typer.Option("--from", metavar="FILE", help="Read the matrices A, B, C, W, … from a .mat or .npz file."),
    ] = None,
    kind: Kind = None,
    dt: Annotated[
        float | None, typer.Option(help="Sampling period of the model in seconds; 0: continuous time.")
    ] = None,
    yes: Annotated[
        bool, typer.Option("--yes", help="With --from: ask no questions, and use their default answers.")
    ] = False,
    answers: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="Continue with the answers in this file, one per line; `taciturn new` writes such a file after "
            "Ctrl-C.",
        ),
    ] = None,
) -> None:
    """Write a commented problem file, from answers to questions or from matrices in a file.

    The questions concern, in this order: continuous or discrete time, and dt; A; B; what is measured, and its noise;
    the noise of the states; LQG or a controller that you keep; further parts, such as wireless nodes, losses,
    batteries, set-points, disturbances and limits; the goal, or a policy kind; the parameters of the policy. If answers
    come from a pipe, the first invalid answer is an error. Scripts should use --from.
    """
    from taciturn.extend import check_format, number, read_text, why_unreadable, write_whole
    from taciturn.problem.matlab_and_numpy import read_given
    from taciturn_new.questions import Questions

    def refuse_to_overwrite() -> None:
        if out.exists():
            raise ProblemError(
                f"the file {out} already exists; expected the name of a new file: files are not overwritten"
            )

    if not out.suffix:
        raise ProblemError(
            f"the file name {str(out)!r} has no extension; expected the name of a TOML file, such as {out}.toml"
        )
    check_format(out, (".toml",), "problem file")
    refuse_to_overwrite()
    if yes and source is None:
        raise ProblemError("--yes is given without --from; expected both options, or neither of them")
    if dt is not None:
        number("--dt", dt, 0.0, closed=True)
    given, kept = None if source is None else read_given(source), list[str]()
    if answers is not None:
        try:
            kept = read_text(answers, LARGEST).splitlines()
        except (OSError, UnicodeDecodeError) as error:
            raise ProblemError(
                f"--answers {str(answers)!r} cannot be read ({why_unreadable(error)}); expected a file of answers"
            ) from None
    questions = Questions(kept, yes)
    if questions.patient and not yes:
        typer.echo(HELLO)
    text = _answered(questions, given, source, out, dt, kind)
    refuse_to_overwrite()
    write_whole(out, text.encode())
    if given is not None and "D" in given.arrays:
        from taciturn.model.plant import FED

        typer.echo(f"D in {source} is read as a direct feedthrough: {FED}")
    if given is not None and given.ignored:
        typer.echo(f"ignored in {source}: {', '.join(given.ignored)}")
    typer.echo(f"written: {out}")
    if questions.patient:
        _evaluate(out)
    typer.echo(
        f"next, in seconds:  taciturn show {out}\n                   taciturn evaluate {out}\n"
        f"up to minutes:     taciturn tradeoff {out} --plot {out.stem}.svg"
    )


def _answered(
    questions: Questions, given: Given | None, source: Path | None, out: Path, dt: float | None, kind: str | None
) -> str:
    """Return the text of the problem file; if the questions end early, the answers are saved."""
    from taciturn.extend import remark
    from taciturn_new.interview import Interview
    from taciturn_new.questions import Back

    try:
        with remark("no file was written"):
            while True:
                try:
                    return Interview(questions, given, source, out).complete(dt, kind)
                except Back:
                    questions = questions.again()
    except KeyboardInterrupt:
        with remark(_saved(questions, out)):
            raise
    except ProblemError as error:
        left = _saved(questions, out) if questions.patient and "the input ends" in str(error) else ""
        raise ProblemError(f"{error}{f'; {left}' if left else ''}") from None


def _saved(questions: Questions, out: Path) -> str:
    """Save the answers so far, on a terminal, and return how to continue with them."""
    from taciturn.extend import write_whole

    lines = questions.lines()
    if not lines or not questions.patient:
        return "nothing was answered"
    number, path = 1, out.with_suffix(".answers")
    while path.exists():
        number += 1
        path = out.with_suffix(f".{number}.answers")
    write_whole(path, "".join(f"{line}\n" for line in lines).encode())
    return f"the answers are in {path}: taciturn new {out} --answers {path} continues"


def _evaluate(out: Path) -> None:
    """Print the verdict of a first evaluation, unless it takes long."""
    import taciturn
    from taciturn.extend import OutOfTime, wrapped_text

    try:
        found = taciturn.evaluate(taciturn.load(out), steps=STEPS, after_step=False, time_limit=CHEAP)
    except OutOfTime:
        return
    except TaciturnError as error:
        verdict: tuple[str, ...] = (str(error),)
    else:
        verdict = found.verdict
    for sentence in verdict:
        typer.echo(wrapped_text(f"first evaluation: {sentence}"))
