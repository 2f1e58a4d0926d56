"""A wrong command line is answered with one sentence: the mistake, the given value, and a remedy."""

from __future__ import annotations

import pytest
from cli.conftest import Run


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (("nonsense",), "there is no command 'nonsense'; see taciturn --help"),
        (("--nonsense",), "taciturn has no option --nonsense; see taciturn --help"),
        (
            ("evaluate",),
            "FILE is missing; expected, for example, taciturn evaluate two-mass",
        ),
        (
            ("evaluate", "two-mass", "two-mass"),
            "'two-mass' is one argument too many; expected taciturn evaluate [OPTIONS] {FILE}, with one problem; taci",
        ),
        (
            ("evaluate", "two-mass", "--nonsense"),
            "taciturn evaluate has no option --nonsense; see taciturn evaluate --help",
        ),
        (
            ("evaluate", "two-mass", "--stnd", "9"),
            "taciturn evaluate has no option --stnd; see taciturn evaluate --help. Did you mean '--standard-error'?",
        ),
        (
            ("evaluate", "two-mass", "--theta", "1"),
            "taciturn evaluate has no option --theta; see taciturn evaluate --help; expected a parameter as --set the",
        ),
        (("evaluate", "two-mass", "--policy=lqg"), "taciturn evaluate has no option --policy; see taciturn evaluate "),
        (("evaluate", "two-mass", "theta=1"), "'theta=1' is one argument too many; expected --set theta=1; see"),
        (("evaluate", "two-mass", "--set", "theta", "1"), "'1' is one argument too many; expected --set theta=1; see"),
        (("simulate", "two-mass", "20"), "'20' is one argument too many; expected --steps 20; see"),
        (("simulate", "two-mass", "--ticks", "1.5"), "--steps is '1.5'; expected a whole number; see"),
        (("tradeoff", "two-mass", "theta=1,2"), "'theta=1,2' is one argument too many; expected --over theta=1,2; s"),
        (
            ("tradeoff", "two-mass", "--theta", "1,2"),
            "taciturn tradeoff has no option --theta; see taciturn tradeoff --help; expected the values of a parameter "
            "as --over theta=1,2",
        ),
        (("two-mass",), "'two-mass' is a problem; expected a command before it, such as taciturn evaluate two-mass"),
        (("mine.toml",), "'mine.toml' is a problem; expected a command before it, such as taciturn evaluate mine.toml"),
        (("plot",), "there is no command 'plot'; expected the option --plot OUT.svg of evaluate, show, "),
        (("run", "two-mass"), "there is no command 'run'; expected taciturn evaluate FILE for cost and rate, "),
        (("problems",), "there is no command 'problems'; expected a command and a problem, such as taciturn show two-"),
        (
            ("kinds",),
            "there is no command 'kinds'; taciturn new lists the policy kinds that suit a plant; all kinds: ab",
        ),
        (
            ("help", "evalute"),
            "there is no command 'evalute'; see taciturn --help, which lists the commands. Did you me",
        ),
        (
            ("evaluate", "two-mass", "--stepz", "9"),
            "taciturn evaluate has no option --stepz; see taciturn evaluate --help. Did you mean '--steps'?",
        ),
        (("evaluate", "two-mass", "--seed"), "--seed has no value; expected a value after it"),
        (
            ("evaluate", "two-mass", "--seed", "x"),
            "--seed is 'x'; expected a whole number; see taciturn",
        ),
        (
            ("evaluate", "two-mass", "--seed=1.5"),
            "--seed is '1.5'; expected a whole number; see taciturn",
        ),
        (("evaluate", "two-mass", "--seed", "9" * 5000), "--seed is '999"),
        (("evaluate", "two-mass", "--seed", "-1"), "--seed is -1; expected a whole number of at least 0"),
        (("evaluate", "two-mass", "--steps", "0"), "--steps is 0; expected a whole number of at least 1024"),
        (("evaluate", "two-mass", "--steps", "-5"), "--steps is -5; expected a whole number of at least 1024"),
        (("evaluate", "two-mass", "--steps", "5"), "--steps is 5; expected a whole number of at least 1024"),
        (("evaluate", "two-mass", "--steps", "1.5"), "--steps is '1.5'; expected a whole number; see"),
        (("evaluate", "two-mass", "--steps", "9" * 30), "--steps is 1e+30; expected --steps < 1e+13"),
        (("evaluate", "two-mass", "--standard-error", "0"), "--standard-error is 0; expected 0 < --standard-error"),
        (("evaluate", "two-mass", "--standard-error", "-1"), "--standard-error is -1; expected 0 < --standard-error"),
        (("evaluate", "two-mass", "--standard-error", "nan"), "--standard-error is nan; expected a finite number"),
        (("evaluate", "two-mass", "--standard-error", "inf"), "--standard-error is inf; expected a finite number"),
        (("evaluate", "two-mass", "--standard-error", "x"), "--standard-error is 'x'; expected a number; see"),
        (
            ("evaluate", "two-mass", "--standard-error", "1", "--steps", "2000"),
            "--standard-error and --steps are both given; expected one of them",
        ),
        (
            ("evaluate", "two-mass", "--method", "nonsense"),
            "--method is 'nonsense'; expected one of the methods 'auto', 'simulation', 'exact' or 'conditional",
        ),
        (
            ("evaluate", "two-mass-lqg", "--method", "exact"),
            "--method is 'exact', but the cost of lqg has no closed form in this problem, and its trigger depends",
        ),
        (
            ("evaluate", "two-mass", "--precision", "half"),
            "--precision is 'half'; expected 'float64' or 'float32'",
        ),
        (("bench", "--rounds", "2"), "--rounds is 2; expected a whole number of at least 3"),
        (("bench", "--rounds", "1" + "0" * 20), "--rounds is 1e+20; expected --rounds < 1000"),
        (("bench", "--rounds", "x"), "--rounds is 'x'; expected a whole number; see"),
        (
            ("sweep", "two-mass"),
            "--over is missing; expected, for example, taciturn sweep two-mass --over",
        ),
        (("tradeoff", "two-mass", "--over"), "--over has no value; expected a value after it"),
        (
            ("tradeoff", "two-mass", "--over", "theta=1", "--plot", "x.bmp"),
            "the file 'x.bmp' for the picture ends in '.bmp'; expected",
        ),
        (
            ("tradeoff", "two-mass", "--over", "theta=1", "--plot", "x"),
            "the file 'x' for the picture has no ending; expected a file name",
        ),
        (
            ("tradeoff", "two-mass", "--over", "theta=1", "--plot", "no/such/x.svg"),
            "the folder 'no/such' does not exist; expected an existing folder in which the picture can be saved",
        ),
        (
            ("tradeoff", "two-mass", "--over", "theta=1", "--seed", "-1"),
            "--seed is -1; expected a whole number of at least 0",
        ),
        (
            ("tradeoff", "two-mass", "--over", "theta=1", "--standard-error", "-1"),
            "--standard-error is -1; expected 0 < --standard-error",
        ),
        (
            ("evaluate", "two-mass", "--over", "theta=2"),
            "taciturn evaluate has no option --over; see taciturn evaluate --help; commands with this option: ",
        ),
        (
            ("reproduce", "chapter2", "--theta", "1"),
            "taciturn reproduce has no option --theta; see taciturn reproduce --help",
        ),
        (
            ("reproduce", "Chapter 2"),
            "'Chapter 2' is not a reproducible chapter; expected one of chapter2, chapter3, chapter4, "
            "chapter5, chapter6, chapter7, or all. Did you mean 'chapter2'?",
        ),
        (("reproduce", "chapter99"), "'chapter99' is not a reproducible chapter; expected one of chapter"),
        (
            ("reproduce", "chapter2", "--out", "/dev/null"),
            "the folder '/dev/null' cannot be created (File exists); expected",
        ),
    ],
    ids=lambda value: " ".join(value)[-50:] if isinstance(value, tuple) else "",
)
def test_a_wrong_command_line_is_refused(run: Run, arguments: tuple[str, ...], sentence: str) -> None:
    """Commands, options and their values."""
    assert run(*arguments).sentence.startswith(sentence)
