"""Nodes on a Cortex-M3 and M4F, as QEMU emulates them: the bits of the design, and the instructions they take."""

from __future__ import annotations

import dataclasses
import os
import runpy
import time
from collections.abc import Mapping
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from catalogue import KEEPING
from counts import few, scaled
from runtime.loops import by_hand
from runtime.test_nodes import TANKS

import taciturn
from taciturn.errors import ProblemError
from taciturn.loop import Loop
from taciturn.model.packets import inputs_at, outputs_at, roles
from taciturn.nodes.node import Node
from taciturn.nodes.packet import Packet, Wire
from taciturn.nodes.simulated_plant import SimulatedPlant
from taciturn.problem import Problem
from taciturn.program.ops import Precision
from taciturn_boards import cortex
from taciturn_boards.cortex import M3, M4F, Counts, EmulatedBoard, Main
from taciturn_boards.processor import NodeOnBoard
from taciturn_export import sizes
from taciturn_export.folder import CFolder, print_folder, record_loop
from taciturn_udp.relay import losses

ROOT = Path(__file__).parent.parent.parent
POLICIES: dict[str, tuple[str, Mapping[str, object]]] = {  # problem, and what is changed in it
    "chapter 2": ("two-mass-lqg", {}),
    "chapter 2, model": ("two-mass-lqg", {"actuation": "model"}),
    "chapter 2, drawn": ("two-mass-lqg", {"kind": "stochastic", "theta": None}),
    "chapter 3": ("remote-double-integrator", {}),
    "chapter 3, scalar": ("remote-scalar", {}),
    "chapter 5": ("double-integrator", {}),
    "chapter 6": ("rover", {}),
    "chapter 7": ("lossy-double-integrator", {}),
    "chapter 7, average": ("lossy-double-integrator", {"cost.horizon": None}),
    "chapter 7, told": ("lossy-double-integrator", {"network.protocol": "tcp"}),
    "tank": ("quadruple-tank", {}),
    "tank, crossed": ("quadruple-tank", TANKS["tank, crossed"]),
    **{name: ("pid-tank", changes) for name, changes in KEEPING.items()},
}
ORDINARY = ("chapter 2", "chapter 2, model", "chapter 2, drawn", "chapter 5", "chapter 3, scalar", "chapter 7, told")
SINGLE = ("chapter 2", "chapter 7")
ROWS = 300  # steps that are compiled in
LONG = ("chapter 7, told", "tank, crossed", "kept over bursts")  # a shortened run runs these alone for long


def evidence(name: str) -> int:
    """Return the number of steps of a long run of a policy on a board."""
    return 100_000 if name in LONG else scaled(100_000, 5_000)


SECONDS = 300.0  # that such a run may take on a machine that does other things as well


@pytest.fixture(autouse=True, scope="module")
def tools() -> None:
    """Skip, so that nobody overlooks it, where compiler or emulator are missing."""
    try:
        for name in sizes.PACKAGES:
            sizes.find_tool(name)
    except ProblemError as error:
        pytest.skip(f"NOT SHOWN: nodes on a Cortex-M; {error}")


def problem(name: str) -> Problem:
    """Return a problem by the name of its chapter."""
    file, changes = POLICIES[name]
    return taciturn.load(file).changed(changes) if changes else taciturn.load(file)


def loop_of(name: str, precision: Precision = "float64") -> Loop:
    """Return the closed loop of a policy."""
    found = problem(name)
    return dataclasses.replace(found.close(found.design()), precision=precision)


@cache
def folder_of(name: str, precision: Precision = "float64") -> CFolder:
    """Return its nodes in C."""
    return print_folder(loop_of(name, precision), "device", rows=ROWS)


def check(board: EmulatedBoard, name: str, precision: Precision = "float64", ticks: int = 0) -> str:
    """Run the self-check on a board, with what is compiled in or so many steps of another seed; return what it says."""
    vector = record_loop(loop_of(name, precision), ticks, seed=1) if ticks else None
    return cortex.check_on(board, folder_of(name, precision), vector, patience=SECONDS)


@pytest.mark.parametrize(
    "on", few(zip(ORDINARY, (M3, M4F) * 3, strict=True), 1, 2), ids=lambda on: f"{on[0]}-{on[1].processor}"
)
def test_nodes_on_a_board_decide_and_apply_what_the_design_does(on: tuple[str, EmulatedBoard]) -> None:
    """Hundreds of steps with their packets: every decision, and every bit of the input."""
    name, board = on
    said = check(board, name)
    assert f"{len(folder_of(name).vector.sent)} steps compared, every decision and every bit" in said


@pytest.mark.parametrize("name", few(SINGLE, 0))  # the quick suite counts instructions of such nodes, which are checked
def test_nodes_in_single_precision_have_the_bits_of_the_loop_in_it(name: str) -> None:
    """What the floating-point unit of the M4F computes is what the loop in single precision does."""
    assert "every bit of the input agrees" in check(M4F, name, "float32")
    assert folder_of(name, "float32").vector.applied.tobytes() != folder_of(name).vector.applied.tobytes()


@pytest.mark.evidence
@pytest.mark.parametrize("board", [M3, M4F], ids=lambda board: board.processor)
@pytest.mark.parametrize("name", POLICIES)
def test_nodes_on_a_board_agree_for_long(name: str, board: EmulatedBoard) -> None:
    """100,000 steps of each policy, those behind the end of a finite-horizon run too; one to two seconds each."""
    assert f"{evidence(name)} steps compared" in check(board, name, ticks=evidence(name))


@pytest.mark.evidence
@pytest.mark.parametrize("name", ORDINARY)
def test_nodes_in_single_precision_agree_for_long(name: str) -> None:
    """100,000 steps of each policy on the floating-point unit."""
    assert f"{evidence(name)} steps compared" in check(M4F, name, "float32", evidence(name))


@pytest.mark.evidence
def test_one_bit_that_differs_is_found_on_the_board(tmp_path: Path) -> None:
    """The self-check on the board can fail, and says in which step."""
    folder = folder_of("chapter 2")
    program = cortex.compile_for(M3, folder, cortex.self_check(folder), tmp_path)
    applied = folder.vector.applied.copy()
    applied[123] = np.nextafter(applied[123], 9.0)
    with pytest.raises(ProblemError, match="step 123: the input of the plant is"):
        cortex.run_on(M3, program, dataclasses.replace(folder.vector, applied=applied))


@cache
def counted(board: EmulatedBoard, precision: Precision) -> Mapping[str, Counts]:
    """Return the instructions of the two masses' nodes."""
    return cortex.count_instructions(board, folder_of("chapter 2", precision))


def changed(folder: CFolder, node: str, old: str, new: str) -> CFolder:
    """Return a folder with another text in the source of a node."""
    name = f"device_{node}.c"
    assert folder.files[name].count(old) == 1
    return dataclasses.replace(folder, files={**folder.files, name: folder.files[name].replace(old, new)})


@pytest.mark.parametrize("of", [(M3, "float64", 1000), (M4F, "float32", 7)], ids=lambda of: of[0].processor)
@pytest.mark.evidence
def test_instructions_are_counted_one_by_one(of: tuple[EmulatedBoard, Precision, int]) -> None:
    """So many more instructions in the step of a node are exactly as many more, in step, step and all; else none."""
    board, precision, number = of
    plain = folder_of("chapter 2", precision)
    more = f'{{\n  __asm volatile(".rept {number}\\n\\tnop\\n\\t.endr");\n  const tac_real v0 = memory[0];'
    longer = changed(plain, "actuator", "{\n  const tac_real v0 = memory[0];", more)
    counts, found = counted(board, precision), cortex.count_instructions(board, longer)
    for before, after in zip(counts["actuator"], found["actuator"], strict=True):
        assert after.ticks == before.ticks == ROWS
        assert round(after.mean * ROWS) - round(before.mean * ROWS) == number * ROWS
        assert after.longest - before.longest == number
    assert found["controller"].step == counts["controller"].step


@pytest.mark.evidence
def test_a_tick_takes_more_than_its_step_and_less_than_all() -> None:
    """What is counted of a node contains what it should; a straight line on the M4F has nearly one length."""
    for counts in counted(M4F, "float32").values():
        assert 0 < counts.step.mean < counts.tick.mean < counts.all.mean
        assert counts.step.longest - counts.step.mean < 1  # the compiler makes branches of selects
        assert counts.all.longest > counts.all.mean


@pytest.mark.evidence
@pytest.mark.parametrize("device", ["M3 float64", "M4F float64", "M3 float32", "M4F float32"])
def test_a_generated_step_takes_little_more_than_one_by_hand(device: str) -> None:
    """On the same measurements, with the same decisions; this is a count of instructions, no time.

    The generated step also knows missing samples and manual inputs: some 35 instructions, which only a processor whose
    own unit adds and multiplies in one instruction each shows.
    """
    ways = runpy.run_path(str(ROOT / "benchmarks" / "devices.py"))["contest"](device)
    assert {found["other decisions"] for found in ways.values()} == {0}
    most = 1.35 if device == "M4F float32" else 1.15
    assert ways["generated"]["mean"] <= most * min(ways["loops"]["mean"], ways["hand"]["mean"])


@pytest.mark.evidence
def test_the_sizes_of_nodes_are_those_of_their_parts() -> None:
    """A hundred numbers are 800 bytes of constants; a controller has more code than an actuator, the core most."""
    found = sizes.measure_sizes(M3.target, folder_of("chapter 2"))
    assert set(found) == {"controller", "actuator", "core"}
    assert found["actuator"].code < found["controller"].code < found["core"].code
    header = '#include "device_actuator.h"\n'
    hundred = f"{header}static const tac_real hundred[100] = {{1}};\n"
    larger = changed(folder_of("chapter 2"), "actuator", header, hundred)
    larger = changed(larger, "actuator", "outputs[0] = v6;", "outputs[0] = v6 * *(const volatile tac_real *)hundred;")
    size = sizes.measure_sizes(M3.target, larger)["actuator"]
    assert size.constants - found["actuator"].constants == 800
    assert size.memory == found["actuator"].memory > 400
    smaller = sizes.measure_sizes(M3.target, folder_of("chapter 2"), "-Os")
    assert smaller["core"].code < found["core"].code


class Loops:
    """The nodes of a problem on boards, one each, next to its plant, over links that lose what relays would lose."""

    def __init__(self, file: str, seed: int, into: Path) -> None:
        """Compile the nodes; the first is for the M3, the others for the M4F."""
        self.problem, self.seed = taciturn.load(file), seed
        self.policy = self.problem.design()
        folder = print_folder(self.problem.close(self.policy), "device", rows=1, seed=seed)
        self.programs = {
            node.role: (board, cortex.compile_for(board, folder, cortex.in_the_loop(node), into / node.role))
            for node, board in zip(folder.nodes, (M3, M4F, M4F, M4F, M4F), strict=False)
        }

    def run(self, ticks: int) -> np.ndarray:
        """Return the costs of the steps."""
        nodes = {role: NodeOnBoard(*given) for role, given in self.programs.items()}
        try:
            return self._run(nodes, ticks)
        finally:
            for node in nodes.values():
                node.close()

    def _run(self, nodes: dict[str, NodeOnBoard], ticks: int) -> np.ndarray:
        network, wire = self.problem.network, Wire(self.policy, self.problem.network)
        host = {role: Node(self.policy, role, network=network) for role in roles(self.policy)}
        plant, fates = SimulatedPlant(self.problem.close(self.policy), self.seed), losses(network, self.seed)
        boxes: dict[str, list[bytes]] = {role: [] for role in nodes}
        u, costs = np.zeros(self.policy.model.inputs), np.empty(ticks)
        for tick in range(ticks):
            for role, node in nodes.items():
                box, boxes[role] = boxes[role], []
                y = [plant.measurement[i] for i in outputs_at(self.policy, role)]
                answer = node.step(tick, box, y if host[role].measures else None)
                assert answer.gone
                assert not answer.degraded
                u[inputs_at(self.policy, role)] = u[:0] if answer.input is None else answer.input
                for datagram in answer.datagrams:
                    packet = wire.decode(datagram)
                    assert isinstance(packet, Packet)
                    if packet.kind == "data" and not fates[packet.link].lost(packet.sequence, tick):  # type: ignore[index]
                        listener = next(r for r, one in host.items() if packet.link in one.program.hears)
                        boxes[listener].append(datagram)
            costs[tick] = plant.move(u.tolist())
        return costs


@pytest.mark.parametrize("file", ["two-mass-lqg", "lossy-double-integrator", "quadruple-tank"])
@pytest.mark.evidence
def test_a_plant_with_boards_in_its_loop_costs_what_it_does_with_the_host_s_nodes(file: str, tmp_path: Path) -> None:
    """Measurements go to emulated boards, datagrams between them, inputs to the plant: step by step the same bits."""
    assert Loops(file, 5, tmp_path).run(100).tobytes() == by_hand(file, 100, 5).tobytes()


@pytest.fixture(scope="module")
def controller(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the program of the two masses' controller for the loop."""
    folder = folder_of("chapter 2")
    return cortex.compile_for(M3, folder, cortex.in_the_loop(folder.nodes[0]), tmp_path_factory.mktemp("controller"))


@pytest.mark.evidence
def test_a_question_that_comes_again_has_the_same_answer(controller: Path) -> None:
    """The step is not gone through again: what follows is as if the question had come once."""
    y = folder_of("chapter 2").vector.measured.tolist()
    with NodeOnBoard(M3, controller) as once, NodeOnBoard(M3, controller) as twice:
        for tick in range(30):
            answer = once.step(tick, (), y[tick])
            assert [twice.step(tick, (), y[tick]), twice.step(tick, (), [9.0, 9.0])] == [answer, answer]


@pytest.mark.evidence
def test_a_board_answers_after_bytes_that_are_no_frame(controller: Path) -> None:
    """Noise on the line, a frame with a wrong checksum and half of one: questions are repeated until one is read."""
    y = folder_of("chapter 2").vector.measured.tolist()
    with NodeOnBoard(M3, controller) as clean, NodeOnBoard(M3, controller) as noisy:
        for tick, noise in enumerate((b"noise", b"T\x00\x01a\x00\x00\x00\x00", b"T\xff\xff", b"T\x00\x40half")):
            noisy._line.sendto(noise, noisy._board)
            assert noisy.step(tick, (), y[tick]) == clean.step(tick, (), y[tick])


@pytest.mark.evidence
def test_a_node_that_misses_its_measurement_says_so(controller: Path) -> None:
    """A step without one is not gone through; a datagram that is none is refused, and the node continues."""
    with NodeOnBoard(M3, controller) as node:
        assert not node.step(0).gone
        assert node.step(1, [b"no packet"], [0.5, 0.5]).gone


def test_a_question_that_fits_no_frame_is_refused(controller: Path) -> None:
    """Another number of steps, datagrams or measurements than a frame can say is a mistake of whoever asks."""
    with NodeOnBoard(M3, controller) as node:
        for tick, datagrams, measurement in ((-1, [], [1.0]), (2**64 - 1, [], [1.0]), (0, [b""] * 9, [1.0])):
            with pytest.raises(ProblemError, match="expected a step from 0 to"):
                node.step(tick, datagrams, measurement)
        with pytest.raises(ProblemError, match="256 measurements"):
            node.step(0, [], [1.0] * 256)
        with pytest.raises(ProblemError, match="expected at most 65535 bytes"):
            node.step(0, [bytes(1 << 16)])


def own(text: str, into: Path) -> Path:
    """Compile a program of a few words for the M3."""
    return cortex.compile_for(M3, folder_of("chapter 2"), Main((), (), {"own.c": text}), into)


def test_a_self_check_of_too_many_rows_is_refused_in_a_sentence(tmp_path: Path) -> None:
    """What the linker says of it is not quoted."""
    with pytest.raises(ProblemError, match=r"^the program is larger than the board's 4 MiB; expected a self-check"):
        own("extern const char rows[]; const char rows[5L << 20] = {1}; int main(void) { return rows[0]; }", tmp_path)


def is_alive(process: int) -> bool:
    """Whether a process is there."""
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    return True


@pytest.mark.evidence
def test_a_board_that_says_nothing_is_given_up_and_ended(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """One that hangs, when patience is over; one whose program ends, at once. No emulator is left."""
    started: list[int] = []
    begin = NodeOnBoard._wait

    def note(self: NodeOnBoard, frame: bytes, tick: bytes) -> bytes:
        started.append(self._process.pid)
        return begin(self, frame, tick)

    monkeypatch.setattr(NodeOnBoard, "_wait", note)
    hanging = own("int main(void) { for (;;) { } }", tmp_path / "hanging")
    with pytest.raises(ProblemError, match=r"the Cortex-M3 has not answered for 0.5 s"):
        NodeOnBoard(M3, hanging, patience=0.5)
    before = time.monotonic()
    with pytest.raises(ProblemError, match="the emulator of the Cortex-M3 has ended"):
        NodeOnBoard(M3, own("int main(void) { return 3; }", tmp_path / "ending"), patience=60.0)
    assert time.monotonic() - before < 30.0
    assert len(started) == 2
    assert not any(map(is_alive, started))


def test_an_emulator_ends_with_its_block(controller: Path) -> None:
    """Also where the block is left by an error; and what is asked of it afterwards is refused."""
    with pytest.raises(ValueError, match="mine"), NodeOnBoard(M3, controller) as node:  # noqa: PT012
        process = node._process.pid
        assert is_alive(process)
        raise ValueError("mine")
    assert not is_alive(process)
    with pytest.raises(ProblemError, match="has ended"):
        node.step(0, (), [0.0, 0.0])


@pytest.mark.evidence
def test_what_a_program_fails_with_is_said(tmp_path: Path) -> None:
    """A fault of the processor, a code, a run without an end, a mistake in C."""
    fault = own("int main(void) { return *(volatile int *)0xF0000001; }", tmp_path / "fault")
    with pytest.raises(ProblemError, match="the processor met a fault"):
        cortex.run_on(M3, fault)
    with pytest.raises(ProblemError, match="code 3"):
        cortex.run_on(M3, own("int main(void) { return 3; }", tmp_path / "three"))
    with pytest.raises(ProblemError, match=r"qemu-system-arm has not finished after 0.5 s"):
        cortex.run_on(M3, own("int main(void) { for (;;) { } }", tmp_path / "hanging"), patience=0.5)
    with pytest.raises(ProblemError, match="unused variable"):
        own("int main(void) { int i; return 0; }", tmp_path / "unused")


@pytest.mark.evidence
def test_a_timer_that_does_not_count_instructions_is_not_believed(tmp_path: Path) -> None:
    """The counting program checks its timer with a loop of known length first."""
    folder = folder_of("chapter 2")
    program = cortex.compile_for(M3, folder, cortex.measurement(folder), tmp_path)
    with pytest.raises(ProblemError, match="the timer does not count instructions"):
        cortex.run_on(M3, program)


def test_missing_tools_are_named_with_their_packages(
    controller: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Without compiler or emulator a sentence says which Debian packages bring them."""
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(ProblemError, match="apt install gcc-arm-none-eabi libnewlib-arm-none-eabi"):
        sizes.measure_sizes(M3.target, folder_of("chapter 2"))
    for run in (cortex.run_on, NodeOnBoard):
        with pytest.raises(ProblemError, match="apt install qemu-system-arm"):
            run(M3, controller)
