"""Every mistake in a problem file is one sentence on standard error: where, what, and what was perhaps meant."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

import taciturn
from taciturn.design.catalogue import CATALOGUE
from taciturn.model.packets import fingerprint

if TYPE_CHECKING:
    from conftest import Run, Write

COST = "[cost]\nQ = [[1.0]]\nR = [[2.0]]\n"
LQG = '[policy]\nkind = "lqg"\n'
PERIODIC = '[policy]\nkind = "periodic"\n'
UDP = '[network]\nprotocol = "udp"\n'
BURST = "[network.actuator_burst]\nto_bad = 2\nto_good = 1\nloss_good = 0\nloss_bad = 1\n"
JUMPS = "[plant.jumps]\nrate = 5\ncovariance = [[0, 0], [0, 0.5]]\n"


def plant(more: str = "", **entries: str) -> dict[str, str]:
    """Return the [plant] table of a file with other entries (empty: without the key), and what follows it."""
    keys = {"A": "[[1.2]]", "B": "[[1.0]]", "W": "[[0.01]]", "dt": "1.0"} | entries
    return {"plant": "[plant]\n" + "".join(f"{k} = {v}\n" for k, v in keys.items() if v) + more}


def continuous(more: str = "", policy: str = LQG + "theta = 1", W: str = "[[0, 0], [0, 2.5]]") -> dict[str, str]:
    """Return the tables of a double integrator."""
    tables = plant(more, A="[[0, 1], [0, 0]]", B="[[0], [1]]", W=W, dt="")
    return tables | {"cost": "[cost]\nQ = [[1, 0], [0, 1]]\nR = [[1]]\n", "policy": policy}


def actual(**entries: str) -> dict[str, str]:
    """Return the [plant] table with one for the plant that is simulated."""
    return plant(plant(**entries)["plant"].replace("[plant]", "[plant.actual]"))


def test_a_file_that_is_not_there_is_told_with_the_built_in_problems(run: Run) -> None:
    """And with the one that was perhaps meant."""
    told = (
        "there is no file 'xyzzy'; expected a problem file, or one of the built-in problems double-integrator, inverted"
    )
    assert run("evaluate", "xyzzy").sentence.startswith(told)
    assert run("evaluate", "twomass").sentence.endswith("Did you mean 'two-mass'?")
    assert run("evaluate", "two-mass.toml").sentence.startswith("there is no file 'two-mass.toml'")
    assert run("evaluate", "../problems/two-mass").sentence.startswith("there is no file '../problems/two-mass'")


def test_what_is_no_text_file_is_refused(run: Run, tmp_path: Path) -> None:
    """A folder, a name that is too long, a program, another encoding."""
    assert (
        run("evaluate", str(tmp_path)).sentence
        == f"the problem file '{tmp_path}' cannot be read (it is not a regular file); expected a TOML file"
    )
    assert run("evaluate", "x" * 5000).sentence.endswith("cannot be read (File name too long); expected a TOML file")
    path = tmp_path / "binary.toml"
    for content in (bytes(range(256)), "[plant]".encode("utf-16")):
        path.write_bytes(content)
        assert (
            run("evaluate", str(path)).sentence
            == f"the problem file '{path}' cannot be read (it is not UTF-8 text: invalid start byte); expected "
            "a TOML file"
        )


@pytest.mark.parametrize(
    ("text", "what"),
    [
        ("[plant]\nA = [[1.0]\nB = [[1.0]]", "Unclosed array (at line 3, column 1)"),
        ("[plant]\nA = \n", "Invalid value (at line 2, column 5)"),
        ("[plant]\n\n[plant]\n", "Cannot declare ('plant',) twice (at line 3, column 7)"),
        (
            "A = " + "[" * 5000 + "]" * 5000,
            "its values are nested too deeply; expected tables whose values are at most matrices",
        ),
        ("A = " + "9" * 5000, "Exceeds the limit"),
    ],
    ids=["array", "value", "twice", "nested", "number"],
)
def test_what_is_not_toml_is_refused_at_its_line(run: Run, tmp_path: Path, text: str, what: str) -> None:
    """Python's parser knows where."""
    path = tmp_path / "wrong.toml"
    path.write_text(text)
    assert run("evaluate", str(path)).sentence.startswith(f"{path} is not valid TOML: {what}")


@pytest.mark.parametrize(
    ("tables", "sentence"),
    [
        ({"plant": ""}, "the table [plant] is missing; expected a file with the tables [plant], [cost] and [policy]"),
        ({"cost": ""}, "the table [cost] is missing; expected a file with the tables [plant], [cost] and [policy]"),
        ({"policy": ""}, "the table [policy] is missing; expected a file with the tables [plant], [cost] and [policy]"),
        (plant(A=""), "the key plant.A is missing; expected it in [plant]"),
        (plant(W=""), "plant.W is missing; expected the process-noise covariance per step (zeros for none)"),
        (continuous(W=""), "W is missing; expected the noise intensity per second (zeros for none), or jumps"),
        (
            continuous("[plant.jumps]\nrate = 1"),
            "the key plant.jumps.covariance is missing; expected it in [plant.jumps]",
        ),
        ({"cost": "[cost]\nQ = [[1.0]]"}, "the key cost.R is missing; expected it in the table [cost]"),
        (
            {"more": "[network.actuator_burst]\nto_bad = 1"},
            "the key network.actuator_burst.to_good is missing; expected",
        ),
        (
            {"more": "[reference]\nstates = [[1]]"},
            "the key reference.inputs is missing; expected both reference.states and reference.inputs",
        ),
        (
            {"policy": "[policy]\ntheta = 1"},
            "policy.kind is missing; expected one of the policy kinds absolute, all-time",
        ),
        ({"policy": LQG}, "policy.theta is missing; expected this parameter, which the policy kind lqg requires"),
    ],
    ids=lambda value: value[:30] if isinstance(value, str) else "",
)
def test_a_missing_table_or_key_is_named(run: Run, write: Write, tables: dict[str, str], sentence: str) -> None:
    """With the table that expects it."""
    path = write(**tables)
    assert run("evaluate", path).sentence.startswith(f"{path}: {sentence}")


@pytest.mark.parametrize(
    ("tables", "key", "meant"),
    [
        (
            {"more": "[plnt]"},
            "plnt is not a known key; expected one of plant, cost, network, nodes, links, reference",
            "plant",
        ),
        (plant(input_limits="[1.0]"), "plant.input_limits is not a known key; expected one of A, B, C,", "input_limit"),
        (plant(a="[[1.0]]"), "plant.a is not a known key; expected one of A, B, C, D, W, V, E, dt,", "A"),
        (plant("[plant.initial]\nmeen = [1]"), "plant.initial.meen is not a known key; expected one of mean,", "mean"),
        (continuous("[plant.jumps]\nrat = 1"), "plant.jumps.rat is not a known key; expected one of rate,", "rate"),
        (actual(AA="[[1]]"), "plant.actual.AA is not a known key; expected one of A, B, C, D, W, V, E, dt,", "A"),
        ({"cost": COST + "horison = 5"}, "cost.horison is not a known key; expected one of Q, R, N,", "horizon"),
        ({"more": "[network]\nsensor_los = 0.1"}, "network.sensor_los is not a known key; expected", "sensor_loss"),
        ({"more": "[network.sensor_burst]\nto_bd = 1"}, "network.sensor_burst.to_bd is not a known key;", "to_bad"),
        (
            {"more": "[reference]\nstate = [[1]]"},
            "reference.state is not a known key; expected one of states,",
            "states",
        ),
        (
            {"policy": LQG + "thet = 1"},
            "policy.thet is not a parameter of the policy kind lqg; expected one of theta, period,",
            "theta",
        ),
        (
            {"policy": PERIODIC + "evry = 2"},
            "policy.evry is not a parameter of the policy kind periodic; expected one of every,",
            "every",
        ),
        (
            {"policy": '[policy]\nkind = "lgq"'},
            "policy.kind is 'lgq'; expected one of the policy kinds absolute, all-time",
            "lqg",
        ),
    ],
    ids=lambda value: value[:30] if isinstance(value, str) else "",
)
def test_an_unknown_key_is_named_with_the_one_meant(
    run: Run, write: Write, tables: dict[str, str], key: str, meant: str
) -> None:
    """In every table of the file."""
    path = write(**tables)
    told = run("evaluate", path).sentence
    assert told.startswith(f"{path}: {key}")
    assert told.endswith(f". Did you mean '{meant}'?")


NUMBERS = """
[plant]
A = 1.2
B = 1
C = 2.0
W = 0.01
V = 0.1
E = 2.0
dt = 1.0
input_limit = 5
input_rate = 2.5
[plant.initial]
mean = 1.0
covariance = 0.5
[limits]
outputs = 1.0
high = 3.0
"""
FOLLOWED = """
[cost]
Q = 1.0
R = 2.0
N = 0.5
[[disturbance]]
enters = 1.0
measured = 0.5
wander = 1e-3
[reference]
outputs = 2.0
value = 1.5
[policy]
kind = "absolute"
threshold = 0.5
weight = 2.0
"""
KEPT = """
[cost]
output_variance = 1.0
input_variance = 4.0
[controller]
A = 1.0
B = 1.0
C = 0.1
D = 0.2
E = 0.0
setpoint = 1.0
[policy]
kind = "excess"
theta = 0.1
"""


@pytest.mark.parametrize("tables", [FOLLOWED, KEPT])
def test_a_number_stands_for_a_vector_or_matrix_with_one_entry(tables: str) -> None:
    """Everywhere in a file."""
    matrices = re.sub(r"(?m)^(\w) = (\S+)$|^(covariance|outputs|weight) = (\S+)$", r"\1\3 = [[\2\4]]", NUMBERS + tables)
    vectors = "mean|enters|measured|high|value|setpoint|input_limit|input_rate|input_variance|output_variance"
    rows = re.sub(rf"(?m)^({vectors}) = (\S+)$", r"\1 = [\2]", matrices)
    assert rows.count("[[") >= 11
    found = [taciturn.problem.parse(tomllib.loads(text), "") for text in (NUMBERS + tables, rows)]
    assert [repr(one.plant) for one in found[1:]] == [repr(found[0].plant)]
    one, other = (problem.design() for problem in found)
    assert fingerprint(one, found[0].network) == fingerprint(other, found[1].network)
    assert one.cost_all_time == other.cost_all_time


def test_what_the_library_passes_itself_is_no_parameter(run: Run, write: Write) -> None:
    """The network of a design is a table, not a key of [policy]."""
    told = run("evaluate", write(policy=LQG + "theta = 1\nnetwork = 1")).sentence
    assert (
        "policy.network is not a parameter of the policy kind lqg; expected one of theta, period, trigger, epsilon"
        in told
    )


@pytest.mark.parametrize(
    ("tables", "sentence"),
    [
        (plant(A='"1.2"'), "plant.A is '1.2'; expected a list of rows, such as [[0.9, 0.1], [0.0, 0.8]]"),
        (plant(A="true"), "plant.A is True; expected a number"),
        (plant(A="[true]"), "plant.A[0] is True; expected a number"),
        (plant(input_limit='"5"'), "plant.input_limit is '5'; expected a list"),
        (plant(A='[["1.2"]]'), "plant.A[0][0] is '1.2'; expected a number"),
        (plant(A="[[true]]"), "plant.A[0][0] is True; expected a number"),
        (plant(A="[[1979-05-27]]"), "plant.A[0][0] is datetime.date(1979, 5, 27); expected a number"),
        (plant(A=f"[[{'9' * 400}]]"), f"plant.A[0][0] is {'9' * 57}…; expected a number"),
        (plant(dt='"1"'), "plant.dt is '1'; expected a number"),
        (plant(dt="true"), "plant.dt is True; expected a number"),
        (plant(initial="1"), "plant.initial is 1; expected a table"),
        ({"plant": "[[plant]]\ndt = 1"}, "plant is [{'dt': 1}]; expected a table"),
        ({"cost": COST + "horizon = 5.5"}, "cost.horizon is 5.5; expected a whole number"),
        ({"cost": COST + "horizon = true"}, "cost.horizon is True; expected a whole number"),
        ({"cost": COST + 'discount = "0.9"'}, "cost.discount is '0.9'; expected a number"),
        ({"more": UDP + "actuator_loss = true"}, "network.actuator_loss is True; expected a number"),
        ({"more": "[network]\nprotocol = 1"}, "network.protocol is 1; expected a string"),
        ({"policy": LQG + "theta = true"}, "policy.theta is True; expected a number"),
        ({"policy": LQG + 'theta = "0.1"'}, "policy.theta is '0.1'; expected a number"),
        ({"policy": LQG + "theta = [1.0]"}, "policy.theta is [1.0]; expected a number"),
        ({"policy": LQG + "theta = 1\ntrigger = 'both'"}, "policy.trigger is 'both'; expected 'joint' or 'separate'"),
        ({"policy": LQG + "theta = 1\ntrigger = 1"}, "policy.trigger is 1; expected 'joint' or 'separate'"),
        ({"policy": LQG + "theta = 1\nactuation = 'held'"}, "policy.actuation is 'held'; expected 'hold' or 'model'"),
        ({"policy": PERIODIC + "every = 2.0"}, "policy.every is 2.0; expected a whole number"),
        ({"policy": PERIODIC + "every = true"}, "policy.every is True; expected a whole number"),
        ({"policy": PERIODIC + "every = [4, 0.5]"}, "policy.every is [4, 0.5]; expected a whole number"),
        (
            {"policy": "[policy]\nkind = 1"},
            f"policy.kind is 1; expected one of the policy kinds {', '.join(CATALOGUE)}",
        ),
        ({"plant": "policy = 1\n" + plant()["plant"], "policy": ""}, "policy is 1; expected a table"),
    ],
    ids=lambda value: value[:30] if isinstance(value, str) else "",
)
def test_a_value_of_the_wrong_type_is_shown_at_its_place(
    run: Run, write: Write, tables: dict[str, str], sentence: str
) -> None:
    """Neither a truth nor a text is taken for a number."""
    path = write(**tables)
    assert run("evaluate", path).sentence == f"{path}: {sentence}"


@pytest.mark.parametrize(
    ("tables", "sentence"),
    [
        (
            plant(A="[[1], [2, 3]]"),
            "A has rows of different lengths: row 2 has 2 entries, and row 1 has 1 entry; expected rows of equal len",
        ),
        (
            plant(W="[[1], 2]"),
            "W has rows of different lengths: row 2 is 2.0, and row 1 has 1 entry; expected rows of equal",
        ),
        (plant(A="[1.2]"), "A has shape (1,); expected the shape (any, any) = (states, states), such as [[1.2]]"),
        (plant(A="[[nan]]"), "A contains the number nan at index (0, 0); expected an array of finite numbers"),
        (plant(B="[[inf]]"), "B contains the number inf at index (0, 0); expected an array of finite numbers"),
        (plant(A="[[]]"), "A has shape (1, 0); expected a square matrix with at least one state"),
        (plant(dt="nan"), "dt is nan; expected a finite number"),
        (plant(dt="0"), "dt is 0; expected 0 < dt"),
        (
            plant(B="[[0.0]]"),
            "(A, B) is not stabilisable: no input affects the growing mode with the eigenvalue 1.2;",
        ),
        (
            plant(C="[[0.0]]"),
            "(A, C) is not detectable: no measurement shows the growing mode with the eigenvalue 1.2;",
        ),
        (
            plant(function="'f.py'"),
            "plant.function is 'f.py'; expected 'file.py:name', a Python file and a function in",
        ),
        (plant(function="'f.py:f'", dt=""), "plant.function is given without plant.dt; expected dt, the seconds per"),
        (plant(function="3"), "plant.function is 3; expected a string"),
        (
            plant(JUMPS),
            "plant.jumps is given with plant.dt; expected jumps only with a continuous-time plant: remove dt",
        ),
        (continuous(JUMPS), "W and jumps are both given; expected one kind of noise: remove one"),
        (actual(dt=""), "plant.actual.dt is missing, but plant.dt is 1 s; expected the same time step in both"),
        (actual(dt="0.5"), "plant.actual.dt is 0.5 s, but plant.dt is 1 s; expected the same time step in both"),
        (actual(B="[[1, 1]]"), "[plant.actual] has 2 inputs; expected 1 input, as in [plant]"),
        (actual(W="[[-1]]"), "[plant.actual]: W has the eigenvalue -1; expected a positive semidefinite matrix"),
        ({"cost": "[cost]\nQ = [[-1]]\nR = [[1]]"}, "Q has the eigenvalue -1; expected a positive semidefinite matrix"),
        ({"cost": "[cost]\nQ = [[1]]\nR = [[-1]]"}, "R has the eigenvalue -1; expected a positive semidefinite matrix"),
        ({"cost": COST + "N = [[10.0]]"}, "[[Q, N], [N', R]] has the eigenvalue -8.5"),
        (
            {"cost": COST + "terminal = [[1.0]]"},
            "terminal is given without horizon; expected both horizon and terminal, or neither of them",
        ),
        ({"more": UDP + BURST}, "network.actuator_burst: to_bad is 2; expected 0 ≤ to_bad ≤ 1"),
        ({"more": "[network]\nprotocol = 'utp'"}, "network.protocol is 'utp'; expected 'udp', 'tcp' or 'ideal'"),
        (
            {"more": "[reference]\nstates = [[1]]\ninputs = [[1]]"},
            "[reference] is given, which the policy kind lqg does not use; expected",
        ),
    ],
    ids=lambda value: value[:30] if isinstance(value, str) else "",
)
def test_data_that_do_not_fit_are_refused_with_the_files_name(
    run: Run, write: Write, tables: dict[str, str], sentence: str
) -> None:
    """The sentences of the model, after the name of the file."""
    path = write(**tables)
    assert run("evaluate", path).sentence.startswith(f"{path}: {sentence}")


@pytest.mark.parametrize(
    ("tables", "sentence"),
    [
        ({"policy": LQG + "theta = -0.1"}, "theta is -0.1; expected 0 ≤ theta"),
        ({"policy": LQG + "theta = nan"}, "theta is nan; expected a finite number"),
        (
            {"policy": LQG + "theta = 1\nepsilon = 1"},
            "epsilon is given with the joint trigger, which does not use it; expected trigger = 'separate', or no "
            "epsilon: use two runs to compare the two triggers",
        ),
        ({"policy": LQG + "theta = 1\ntrigger = 'separate'\nepsilon = 0"}, "epsilon is 0; expected 0 < epsilon < "),
        ({"policy": LQG + "theta = 1\ntrigger = 'separate'\nepsilon = 99"}, "epsilon is 99; expected 0 < epsilon < "),
        ({"policy": LQG + "theta = 1\ntrigger = 'separate'\nepsilon = nan"}, "epsilon is nan; expected "),
        ({"policy": LQG + "theta = 1\nperiod = 0.1"}, "period is 0.1, but the plant is discrete in time; expected no"),
        (continuous(), "period is missing; expected the sampling period in seconds, as the plant is continuous"),
        (continuous(policy=LQG + "theta = 1\nperiod = 0"), "period is 0; expected 0 < period"),
        (
            continuous(policy=PERIODIC + "every = 9"),
            "period is missing; expected the sampling period in seconds, as the plant",
        ),
        (
            continuous(JUMPS.replace("rate = 5", "rate = 5000"), LQG + "theta = 1\nperiod = 0.1", ""),
            "a step of 0.1 s has 500 jumps on average, too many to draw one by one; expected shorter steps, or Wiener",
        ),
        ({"policy": PERIODIC}, "every is missing; expected the number of steps between sends, at least 1, or a list"),
        ({"policy": PERIODIC + "every = 0"}, "every is 0; expected a whole number of at least 1"),
        ({"policy": PERIODIC + "every = []"}, "every = []; expected the number of steps between sends, at least 1"),
        (
            {"cost": COST + "horizon = 5"},
            "cost.horizon is 5, which the policy kind lqg does not use; expected an average cost: remove this key",
        ),
        (
            {"cost": COST + "discount = 0.9"},
            "cost.discount is 0.9, which the policy kind lqg does not use; expected an average cost",
        ),
        (
            {"cost": continuous()["cost"]},
            "Q has the shape (2, 2) and R the shape (1, 1); expected the shapes (1, 1) and (1, 1), for the states and",
        ),
        (
            {"more": UDP},
            "network.protocol is given, which the policy kind lqg does not use; expected ideal links: remove "
            "network.protocol (`taciturn "
            "network FILE --loss P` drops packets of any policy kind), or the kind distributed or excess",
        ),
        (
            {"more": UDP + "actuator_loss = 0.1"},
            "network.protocol is given, which the policy kind lqg does not use; expected ideal links",
        ),
        (
            {"more": "[network]\ndelay = 1"},
            "network.delay is given, which the policy kind lqg does not use; expected ideal links: remove",
        ),
    ],
    ids=lambda value: value[:30] if isinstance(value, str) else "",
)
def test_what_a_policy_cannot_use_is_refused(run: Run, write: Write, tables: dict[str, str], sentence: str) -> None:
    """Parameters out of range, and keys that the policy would have to ignore."""
    path = write(**tables)
    key = "policy." if sentence.split()[0] in ("theta", "epsilon", "period", "every") else ""
    assert run("evaluate", path).sentence.removeprefix(f"{path}: ").startswith(f"{key}{sentence}")


@pytest.mark.parametrize("name", ["crlf.toml", "bom.toml", "ünï cödé 質量.toml", "no ending", ".hidden"])
def test_a_file_from_another_machine_is_read(run: Run, write: Write, tmp_path: Path, name: str) -> None:
    """Line ends of Windows, a byte-order mark, and names of any letters."""
    text = Path(write(policy='[policy]\nkind = "all-time"')).read_text(encoding="utf-8")
    path = tmp_path / name
    path.write_bytes((b"\xef\xbb\xbf" if "bom" in name else b"") + text.replace("\n", "\r\n").encode())
    answer = run("evaluate", str(path))
    assert (answer.code, answer.err) == (0, "")


def test_what_cannot_be_printed_does_not_reach_the_terminal(run: Run, write: Write) -> None:
    """A key with control characters is shown without them."""
    told = run("evaluate", write(more='"\\u001b[31mred\\nline" = 1')).sentence
    assert told.isprintable()
    assert "red line is not a known key" in told
