"""Folder with the nodes of a policy in C99: sources, a self-check with its data, a build file, and instructions.

The self-check compares exported nodes, bit for bit, with recorded measurements, losses, decisions and inputs of a loop
(``RecordedRun``).
"""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.resources import files
from itertools import groupby
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from taciturn import __version__
from taciturn.errors import ProblemError
from taciturn.extend import Array, Displayed, factor, number_of, write_whole
from taciturn.loop import Loop
from taciturn.model.network import REFERENCE, Network
from taciturn.model.packets import (
    acting_pieces,
    inputs_at,
    outputs_at,
    place_of,
    plant_links,
    receiver_of,
    roles,
    sender_of,
    wire_links,
)
from taciturn.model.policy import Policy
from taciturn.model.result import VERDICT, Field, Result, plain_fields
from taciturn.model.steps import Received, Send
from taciturn.model.wire import SETPOINT
from taciturn.program import machine
from taciturn.program import numpy as interpreter
from taciturn.program.all_nodes import ACTING
from taciturn.program.c import REAL, c_literal, constant_array
from taciturn.program.ir import Program
from taciturn.program.late import NEVER, pieces_of_links
from taciturn.program.missing import SAMPLED
from taciturn.program.ops import Arrived, Entry, Name, Sent, is_entry, named
from taciturn_export.library import entries_text, print_library
from taciturn_export.node import (
    EXPORTED,
    CNode,
    CoreSizes,
    check_delays,
    identifier,
    link_code,
    print_node,
    table,
    waiting_for,
)


@dataclass(frozen=True, eq=False, repr=False)
class RecordedRun(Displayed):
    """A recorded run of a closed loop, with one row for each step.

    Args:
        links: links on which packets are sent, in the order of the columns.
        measured: measurements y, (steps, p); NaN where a sample is missing.
        drawn: uniform random numbers that the policy draws, (steps, draws).
        arrived: 1 if a packet was sent and arrived, otherwise 0, (steps, links); on a link with random delays, 1 plus
            the delay of the packet that was sent, in pieces of a step of its receiver.
        sent: 1 if a packet was sent, otherwise 0, (steps, links).
        applied: inputs u that the actuators applied, (steps, m); if packets arrive within a period, those of its pieces
            one after the other.
        order: outputs and inputs of the plant in the order in which the nodes measure and apply them.
    """

    links: tuple[str, ...]
    measured: Array
    drawn: Array
    arrived: Array
    sent: Array
    applied: Array
    order: tuple[list[int], list[int]]

    @property
    def rows(self) -> Array:
        """All recorded columns, one row per step: first the inputs of all nodes, then their outputs.

        The measurements and the inputs are in the order of the nodes.
        """
        outputs, inputs = self.order
        return np.hstack([self.measured[:, outputs], self.drawn, self.arrived, self.sent, self.applied[:, inputs]])


def record_loop(loop: Loop, steps: int, seed: int = 0, drawn: Array | None = None) -> RecordedRun:
    """Simulate a loop bit-exactly, and record measurements, losses, decisions and control inputs."""
    loop = loop.in_units
    program, plant = loop.open_program(), loop.problem.plant
    generator = np.random.default_rng(seed)
    noise = {"w": factor(plant.W), "v": factor(plant.V)}
    supplied: dict[Name, Array] = {}
    for name, spread in noise.items():
        values = generator.standard_normal((steps, spread.shape[1])) @ spread.T
        supplied |= {Entry(name, i): column for i, column in enumerate(values.T)}
    inputs = np.array([supplied[name] if name in supplied else generator.random(steps) for name in program.inputs])
    own = [program.inputs.index(name) for name in drawn_by_the_policy(program)]
    if drawn is not None:
        inputs[own] = drawn.T
    run = machine.Kernel(program, "parity").run if machine.available() else interpreter.run
    outputs = run(program, loop.start(program, 1, seed), steps, inputs.T[:, :, None]).outputs
    found = {name: values[:, 0] for name, values in outputs.items()}
    measured = [*named("y", range(plant.sensed)), *named(REFERENCE, range(plant.set_points))]
    links: tuple[str, ...] = tuple(step.link for step in loop.policy.steps if isinstance(step, Send))
    vector = RecordedRun(
        links,
        _columns([found[name] for name in measured], steps),
        _columns([inputs[i] for i in own], steps),
        _columns([_fates(loop, found, link) for link in links], steps),
        _columns([found[Sent(link)] for link in links], steps),
        _columns(_acting(loop, found), steps),
        entries_of_nodes(loop.policy, loop.network),
    )
    finite = np.isfinite(vector.rows).all(axis=1)
    if not finite.all():
        raise ProblemError(
            f"the loop leaves the range of {loop.precision} after {number_of(int(finite.argmin()), 'step')}; "
            "expected a policy that stabilises the loop over this network"
        )
    for name, values in found.items():
        if is_entry(name, SAMPLED):
            vector.measured[values == 0.0, name.index] = np.nan
    return vector


def _fates(loop: Loop, found: dict[Name, Array], link: str) -> Array:
    """Return for each step 0 if no packet was sent, or it was dropped, and otherwise 1 plus its delay in pieces."""
    late = found.get(Arrived(link, 0))
    if late is None:
        return found[Received(link)]
    count, pieces = pieces_of_links(loop.network, loop.policy.tick)[link], loop.problem.pieces
    whole, piece = np.divmod(late, 1 if pieces is None else len(pieces.cuts))
    own = np.searchsorted(_places(loop), piece, side="right") - 1 if count > 1 else 0
    return np.where(late < NEVER, 1.0 + whole * count + own, 0.0)


def _places(loop: Loop) -> list[int]:
    """Return the pieces of the plant's period with which those begin at which packets may arrive."""
    cuts, pieces = loop.network.cuts(loop.policy.tick) or (0.0,), loop.problem.pieces
    return [0] if pieces is None else [int(np.abs(np.array(pieces.cuts) - cut).argmin()) for cut in cuts]


def _acting(loop: Loop, found: dict[Name, Array]) -> list[Array]:
    """Return the inputs of the plant, in each piece of a period in which packets may arrive."""
    m = loop.problem.plant.inputs
    if Entry(ACTING, 0) not in found:
        return [found[Entry("applied", i)] for i in range(m)]
    return [found[Entry(ACTING, place * m + i)] for place in _places(loop) for i in range(m)]


def entries_of_nodes(policy: Policy, network: Network) -> tuple[list[int], list[int]]:
    """Return the numbers of the plant's outputs and inputs, in the order in which nodes measure and apply them.

    If packets arrive within a period, the inputs of a node are those of its pieces, and of another one the last.
    """
    names, links, m = roles(policy), plant_links(policy).values(), policy.model.inputs
    count = len(network.cuts(policy.tick) or (0.0,))
    pieces = {role: range(count - acting_pieces(policy, network, role), count) for role in names}
    return [i for role in names for ends in links if ends.measures == role for i in ends.outputs], [
        piece * m + i for role in names for piece in pieces[role] for i in inputs_at(policy, role)
    ]


def drawn_by_the_policy(program: Program) -> list[Name]:
    """Return the inputs of ``Loop.open_program`` through which the policy's uniform random numbers enter."""
    drawn = [op for name, op in program.outputs.items() if is_entry(name, "drawn")]
    return [program.inputs[program.ops[op].arguments[0]] for op in drawn]


def _columns(columns: list[Array], steps: int) -> Array:
    return np.array(columns).reshape(len(columns), steps).T


CORE_SOURCES = tuple(
    f"taciturn_{part}.c" for part in ("hash", "packet", "proof", "inbox", "outbox", "node", "clock", "state")
)
CORE = ("taciturn.h", "taciturn_packet.h", "taciturn_parts.h", *CORE_SOURCES)
EXCHANGE = ("taciturn_exchange.h", "taciturn_exchange.c")
CHECK = ("selfcheck.h", "selfcheck.c")
WAITING = 4  # size of the buffer for early packets of each link, a power of two
ROWS = 500  # steps of the self-check
OURS = re.compile(r'((/\*|#|<!--) |\{ "description": ")(Generated by )?taciturn[: ]')  # first line of exported files
GENERATED_BY = "/* Generated by taciturn"  # first line of files that a new export may remove
FLAGS = "-std=c99 -O2 -Wall -Wextra -Wconversion -Wpedantic -ffp-contract=off"


def _nodes(nodes: Sequence[CNode]) -> list[dict[str, Any]]:
    return [
        {"role": one.role, "type": one.name, "operations": one.operations, "constants": one.constants} for one in nodes
    ]


def _sizes(found: CFolder) -> list[tuple[str, str]]:
    return [(one.role, f"{one.operations} operations per step, {one.constants} constants") for one in found.nodes]


@dataclass(frozen=True, eq=False, repr=False)
class CFolder(Result):
    """The C99 sources of a policy's nodes, as the files of a folder.

    Args:
        name: name of the policy, as an identifier.
        kind: kind of the policy.
        nodes: exported nodes.
        peers: other nodes of the policy, with which the self-check exchanges packets.
        vector: recording that the self-check compares with.
        files: text of each file, by path.
        single: whether numbers have single precision.
        sizes: suffix of the function names that the linker uses.
    """

    FIELDS: ClassVar[tuple[Field[CFolder], ...]] = (
        VERDICT,
        Field("kind", key="policy", say="policy", text="{}, in {of.precision}, as {of.name}"),
        *plain_fields("name", "precision"),
        Field("nodes", json=_nodes, say="", text=_sizes),
        Field("ticks", lambda found: len(found.vector.sent), say="self-check", text="{} steps"),
        Field("files", json=sorted, say="file", text=lambda found: sorted(found.files), part="method"),
    )

    name: str
    kind: str
    nodes: tuple[CNode, ...]
    peers: tuple[CNode, ...]
    vector: RecordedRun
    files: dict[str, str]
    single: bool
    sizes: str

    @property
    def verdict(self) -> tuple[str, ...]:
        """Sentence that names the exported nodes and says how they are checked."""
        nodes, steps = [node.role for node in self.nodes], number_of(len(self.vector.sent), "step")
        return (f"C99 sources of {' and '.join(nodes)}; the self-check compares {steps} bit for bit",)

    @property
    def precision(self) -> str:
        """Format of the numbers."""
        return "float32" if self.single else "float64"

    @property
    def sources(self) -> tuple[str, ...]:
        """Names of the C files of the self-check and of all exported nodes, in alphabetical order."""
        return tuple(sorted(name for name in self.files if name.endswith(".c") and "/" not in name))

    def write(self, folder: Path) -> None:
        """Write all files to the folder, and remove the files of an earlier export from it.

        Raises:
            ProblemError: the folder cannot be written to, or one of the files exists and was not exported.
        """
        try:
            folder.mkdir(parents=True, exist_ok=True)
            there = {path: _first_line(path) if path.is_file() else "" for path in self._found(folder)}
            ours = {folder / name for name in self.files}
            needed = ours | {parent for path in ours for parent in path.parents}
            for path, line in there.items():
                if path in needed and not OURS.match(line):
                    raise ProblemError(
                        f"the file {path} already exists and is not from an earlier export; expected a folder without "
                        "a file of this name"
                    )
            for name, text in self.files.items():
                write_whole(folder / name, text.encode())
            for path, line in there.items():
                if path not in ours and line.startswith(GENERATED_BY):
                    path.unlink()
                    if path.suffix == ".ino" and not any(path.parent.iterdir()):
                        path.parent.rmdir()
        except OSError as error:
            reason = error.strerror or str(error)
            raise ProblemError(
                f"the folder {folder} cannot be written to ({reason}); expected a folder with write permission"
            ) from None

    def _found(self, folder: Path) -> list[Path]:
        """Return the files that an export would replace or needs as folders, and those that an earlier export left."""
        found = [*folder.glob("*.[ch]"), *folder.glob("src/*.[ch]"), *folder.glob("examples/*/*.ino")]
        for name in self.files:
            path = folder / name
            parents = [folder / parent for parent in Path(name).parents]
            found += [path, *(parent for parent in parents if not parent.is_dir())]
        return [path for path in found if os.path.lexists(path)]


def _first_line(path: Path) -> str:
    with path.open(encoding="utf-8", errors="replace") as file:
        return file.readline(1000)


def print_folder(loop: Loop, name: str, *, nodes: Sequence[str] = (), rows: int = ROWS, seed: int = 0) -> CFolder:
    """Return the folder of C99 sources for the nodes of a loop's policy.

    Args:
        loop: loop with plant, policy and network; it also sets the precision of the nodes.
        name: a C identifier that is the prefix of all names.
        nodes: nodes to export; default: all.
        rows: steps that the self-check compares; fewer if the horizon is shorter.
        seed: seed of the draws of policy and self-check.

    Raises:
        ProblemError: the nodes cannot be separated, the policy has no such node, or it is too large for a device.
    """
    policy, network, precision = loop.policy, loop.network, loop.precision
    EXPORTED.check(loop.parts)
    check_delays(network, policy.tick)
    known = roles(policy)
    for node in nodes:
        place_of(policy, node)
    for name_in_c, same in groupby(sorted(known, key=identifier), identifier):
        if len(alike := list(same)) > 1:
            raise ProblemError(
                f"nodes {' and '.join(alike)} have the same name {name_in_c} in C; expected names that differ in more "
                "than hyphens and capital letters"
            )
    found = [
        print_node(
            policy, role, network, f"{name if not nodes or role in nodes else 'selfcheck'}_{identifier(role)}",
            precision=precision, seed=seed, names=loop.names,
        )
        for role in known
    ]  # fmt: skip
    chosen = tuple(node for node in found if not nodes or node.role in nodes)
    peers = tuple(node for node in found if node not in chosen)
    vector = record_loop(loop, min(rows, loop.horizon or rows), seed)
    core = files("taciturn_export") / "core"
    texts = {file: (core / file).read_text(encoding="utf-8") for file in (*CORE, *EXCHANGE, *CHECK)}
    for node in found:
        texts |= {f"{node.name}.h": node.header, f"{node.name}.c": node.source}
    sizes = CoreSizes.of(policy, network, waiting_for(network, policy.tick, WAITING), precision)
    sources = [file for file in (*texts, "selfcheck_data.c") if file.endswith(".c")]
    texts |= print_library(name, policy, CORE, chosen)
    texts |= {
        "taciturn_config.h": sizes.text(_title("sizes of the core")),
        "selfcheck_data.c": _print_check(name, found, vector, loop),
        "CMakeLists.txt": _CMAKE.format(
            name=name, files="\n  ".join([*CORE_SOURCES, *(f"{node.name}.c" for node in chosen)]), flags=FLAGS,
            check="\n  ".join([CHECK[1], EXCHANGE[1], "selfcheck_data.c", *(f"{node.name}.c" for node in peers)]),
        ),
        "README.md": _print_readme(name, chosen, peers, len(vector.sent), loop, " ".join(sorted(sources))),
    }  # fmt: skip
    return CFolder(name, policy.kind, chosen, peers, vector, texts, sizes.single, sizes.suffix)


def _title(what: str) -> str:
    return f"{GENERATED_BY} {__version__}: {what}. Do not edit. */"


def _print_check(name: str, nodes: Sequence[CNode], vector: RecordedRun, loop: Loop) -> str:
    """Return the data of the self-check."""
    lines = [_title("data of the self-check"), "#include <math.h>", '#include "selfcheck.h"']
    lines += [f'#include "{node.name}.h"' for node in nodes]
    for node in nodes:
        lines += [
            "",
            f"static {node.name} memory_of_{node.name};",
            f"static tac_node *start_{node.name}(void)",
            "{",
            "  const tac_key none = {NULL, 0u};",
            f"  return {node.name}_start(&memory_of_{node.name}, 0u, 0u, none);",
            "}",
        ]
    starts = ", ".join(f'{{"{node.role}", start_{node.name}}}' for node in nodes)
    links = ", ".join(link_code(loop.policy, link) for link in vector.links)
    sizes = {
        "node_count": len(nodes), "link_count": len(vector.links), "measured": vector.measured.shape[1],
        "drawn": vector.drawn.shape[1], "applied": len(vector.order[1]), "rows": len(vector.sent),
    }  # fmt: skip
    numbers = [c_literal(float(value), loop.precision) for value in vector.rows.ravel()]
    lines += [
        "",
        f'const char selfcheck_name[] = "{name}";',
        f"const selfcheck_node selfcheck_nodes[] = {{{starts}}};",
        f"const uint8_t selfcheck_links[] = {{{links or '0u'}}};",
        *(f"const size_t selfcheck_{what} = {size}u;" for what, size in sizes.items()),
        constant_array(REAL, "selfcheck_vector", numbers).removeprefix("static "),
    ]
    return "\n".join(lines)


def _print_readme(
    name: str, nodes: Sequence[CNode], peers: Sequence[CNode], rows: int, loop: Loop, sources: str
) -> str:
    single, horizon = loop.precision == "float32", loop.problem.cost.horizon
    return _README.format(
        name=name, kind=loop.policy.kind, version=__version__,
        core=", ".join(f"`{one}`" for one in CORE_SOURCES), flags=FLAGS, rows=rows, sources=sources,
        links=", ".join(
            f"{wire_links(loop.policy).index(link)}: from `{sender_of(loop.policy, link)}` to "
            f"`{receiver_of(loop.policy, link)}`"
            for link in dict.fromkeys(step.link for step in loop.policy.steps if isinstance(step, Send))
        )
        + "".join(
            f", {wire_links(loop.policy).index(link)}: set-points to `{ends.measures}`"
            for link, ends in plant_links(loop.policy).items()
            if link == SETPOINT
        ),
        mission="" if horizon is None else _MISSION.format(horizon=horizon),
        snippets="\n".join(_snippet(loop, one) for one in nodes),
        precision="single precision (float)" if single else "double precision (double)",
        nodes=table(
            [["node", "files", "operations per step", "constants"]]
            + [[one.role, f"`{one.name}.h`, `.c`", str(one.operations), str(one.constants)] for one in nodes]
        ),
        peers=""
        if not peers
        else "Only the self-check uses the other nodes, " + ", ".join(f"`{one.name}.c`" for one in peers) + ".\n",
    )  # fmt: skip


def _snippet(loop: Loop, node: CNode) -> str:
    """Return an example of device code for a node, which compiles without changes."""
    p, m = outputs_at(loop.policy, node.role), inputs_at(loop.policy, node.role)
    shared = "".join(f" (at the {other})" for other in sorted(loop.policy.site(node.role) - {node.role}))
    return _SNIPPET.format(
        node=node.name,
        title=f"{node.role}{shared}",
        apply=f"void apply(const tac_real *input); /* {entries_text('u', m)} */\n" if m else "",
        given=f", const tac_real *measurement /* {entries_text('y', p)} */" if p else "",
        measurement="measurement" if p else "NULL",
        applied="  apply(tac_input(node));\n" if m else "",
    )


_CMAKE = """# Generated by taciturn: do not edit.
cmake_minimum_required(VERSION 3.13)
project({name}_nodes C)
enable_testing()

add_library({name}_nodes STATIC
  {files})
target_include_directories({name}_nodes PUBLIC ${{CMAKE_CURRENT_SOURCE_DIR}})
set_target_properties({name}_nodes PROPERTIES C_STANDARD 99 C_STANDARD_REQUIRED ON C_EXTENSIONS OFF)
# without FMA contraction, so that results are bit-identical to the design
target_compile_options({name}_nodes PUBLIC $<$<NOT:$<C_COMPILER_ID:MSVC>>:-ffp-contract=off>)

add_executable({name}_selfcheck
  {check})
target_link_libraries({name}_selfcheck {name}_nodes)
add_test(NAME {name}_selfcheck COMMAND {name}_selfcheck)
"""
_SNIPPET = """### The {title}

```c
#include "{node}.h"

size_t receive(uint8_t *datagram);
void send(const uint8_t *datagram, size_t size);
{apply}
static {node} memory; /* memory of the node */
static uint8_t datagram[TAC_DATAGRAM];
static tac_node *node;

bool begin(uint32_t epoch)
{{
  const tac_key key = {{NULL, 0}}; /* or a secret of 16 to 32 bytes */
  node = {node}_start(&memory, epoch, 0, key); /* 0: number of the loop */
  return node != NULL; /* NULL: the constants are damaged */
}}

bool step(uint64_t tick{given})
{{
  size_t size;
  while ((size = receive(datagram)) > 0) (void)tac_receive(node, datagram, size);
  const bool done = tac_step(node, tick, {measurement}, NULL); /* NULL: the node draws its random numbers */
  while ((size = tac_send(node, datagram)) > 0) send(datagram, size);
{applied}  return done;
}}
```
"""
_MISSION = """\
* The policy has a horizon of {horizon} steps. After them it continues with its last gains, without a guarantee.
  For the next finite-horizon run start all nodes again, with a larger epoch.
"""
_README = """<!-- Generated by taciturn: do not edit. -->
# {name}: nodes of a control loop in C99

A policy of kind `{kind}`, exported by taciturn {version}, in {precision}. The code allocates no memory and calls no
mathematical library.

{nodes}
{peers}
Run the self-check on this machine: the nodes exchange packets for {rows} steps, and every decision and every bit of the
input is compared with the results of the design. Compile it with the flags of your device too: the self-check detects
flags that change a bit.

```sh
cc {flags} {sources} -o selfcheck && ./selfcheck
```

## On a device

Compile the core, which are {core}, and the `.c` file of the device's
node. PlatformIO, Arduino and Zephyr accept this folder as a library or module; `examples` has programs for Arduino.
Keep your own files in another folder, because a new export replaces the files of this folder. C++ code can
include the headers. Compile the sources as C99 or as C++11.

{snippets}
You write these functions: `receive` returns the size of the next received datagram, or 0. `send` sends a datagram to
its destination. Byte 6 of a datagram is its link ({links}).
Byte 11 is 0 if the datagram goes along its link, as data does, and 1 if it goes back to the sender of the data, as an
acknowledgement does. `apply` sets the input of the plant. Call `begin` once, and `step` in each step.

Byte 5 is the kind of a datagram. Pass on every datagram that `tac_send` writes, and give every datagram that arrives
from another node to `tac_receive`:

| byte 5 | kind | sent |
|---|---|---|
| 0 | data | along the link, in the steps in which the policy sends |
| 1 | acknowledgement | back to the sender of the data, if the policy uses the acknowledgements of this link |
| 2 | mark | after `tac_mark_after`: along the link, or back from a node that only acknowledges on it |
| 5 | challenge | with a key: to the sender of packets that has not proven yet that it is running |
| 6 | answer | with a key: to the node that has sent the challenge |
| 7 | setpoint | from an operator to a controller, whose set-points may change: `taciturn setpoint` |
| 8 | report | back to the operator, with the set-points received and those in effect |
| 9 | manual | from an operator to such a controller: 1 and manual inputs, or 0 for automatic operation |
| 10 | mode | back to the operator, as kind 9, with what is in effect |

The kinds 3 (measurement) and 4 (input) are packets between a node and a plant that is another process. `tac_receive`
discards them: read them with `tac_decode` and write them with `tac_encode`, using `&node->data->wire`. An exception
are the set-points of a controller, if they may change: `tac_receive` takes them as packets of kind 3 on the link
`setpoint`, and `tac_setpoint(node, values)` sets them from the next step on. They remain in effect until then. After
packets of an operator, those of kind 3 have no effect; `tac_setpoints(node, values)` writes the set-points in effect.
`tac_manual(node, values)` lets a controller command given inputs, until `tac_manual(node, NULL)`.

* All nodes use the same **step** numbers. In each step the nodes that measure run first, then the controller, then the
  nodes that apply inputs; leave enough time between them for packets to arrive. A node that starts while the loop runs
  waits for a packet, and starts with step `tac_heard(node) - 1`. If several nodes measure, they need
  the same step number, for example the time of synchronised wall clocks divided by the period.
* The **epoch** must increase with each start of a node whose memory is lost. Use for example a wall clock in seconds,
  or a counter in non-volatile memory. Receivers treat packets with an old epoch as replays and ignore them. With keys
  on all links, the epoch must only differ from those of earlier starts, so it may be random.
* `begin` gives all links the same **key**, or none. `tac_set_keys(node, link, key, other)` gives one link a key of its
  own, by the number of the link, also while the node runs: the node authenticates its packets with `key`, and accepts
  packets with `key` or with `other`, which may be `{{NULL, 0}}`. The node reads the bytes of a key in place, so they
  must remain in memory.
* `NODE_start` returns NULL if the constant data of the node are damaged or belong to another version of the core.
* `tac_step` returns whether the node executed the step. It returns false if the step is not later than the last one, if
  the measurement is beyond FLT_MAX, or if more missed steps are left than one call executes (`tac_behind`,
  `TAC_CATCH_UP`).
* An entry of the measurement that is NaN is **missing**, and so are all entries if the measurement is NULL: call
  `tac_step` also in a step in which no measurement arrives. The filter then predicts, a node without a filter holds the
  last measurement, and `node->counters.missing` counts the step.
* A node without a sensor may begin its steps by the packets that arrive: see `tac_clock_receive` and `tac_clock_due`.
* An actuator whose packets are **delayed at random** may act when a packet arrives: `tac_receive_in(node, datagram,
  size, piece)` takes it in a piece of the running step (the nearest of those in `NODE_CUTS`), and `tac_act(node)` sets
  `tac_input(node)`, whose last numbers are the input from now on. Then send what `tac_send` returns, and call
  `tac_step` when the step is over. Without this, a packet acts at the next step.
* `tac_degraded(node)` returns whether a violated assumption of the policy's theory, such as an unexpected packet loss,
  still affects the node. `node->counters` count what happened to packets. Use `tac_watch(node, ticks, safe_input)`: it
  applies a safe input after `ticks` steps without a packet. Use `tac_mark_after(node, ticks)` at the sender, with a
  third of these steps, so that the watchdog does not expire while the policy is silent. Each link has its own watchdog:
  `tac_silent_on(node, link)` returns whether it has expired, which degrades the node, and `tac_silent(node)` whether
  those of all links have expired. `tac_expire(node)` lets all expire while no step begins.
{mission}
Compile with `-ffp-contract=off`, and without `-ffast-math` or any part of it. Two policies on one device share the
core; compile it with the larger sizes of their two `taciturn_config.h`.
"""
