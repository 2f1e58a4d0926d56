"""Export a policy as a functional mock-up unit (FMU 3.0 or 2.0) for co-simulation in other simulators.

A unit is an archive: XML files that list its variables and sources, the C code of all nodes with the core, and a binary
for the present machine if a compiler is installed.
"""

from __future__ import annotations

import hashlib
import platform
import shutil
import subprocess
import tempfile
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass, replace
from html import escape
from importlib.resources import files
from io import BytesIO
from pathlib import Path
from typing import ClassVar, Literal
from xml.etree import ElementTree as Xml

from taciturn import __version__
from taciturn.errors import ProblemError
from taciturn.extend import Displayed, write_whole
from taciturn.loop import Loop
from taciturn.model.coverage import LATE, LOOPS, Coverage
from taciturn.model.names import Names, Role, unit_of
from taciturn.model.packets import fingerprint, place_of, roles, wire_links
from taciturn.model.result import VERDICT, Field, Result
from taciturn.model.steps import Send
from taciturn.program.c import c_literal
from taciturn_export.folder import CORE, EXCHANGE, FLAGS, GENERATED_BY, ROWS, entries_of_nodes, print_folder
from taciturn_export.node import CNode, core_links, identifier, name_of_links

Version = Literal["3.0", "2.0"]
_TYPES = {
    "number": {"3.0": "Float64", "2.0": "Real"},
    "truth": {"3.0": "Boolean", "2.0": "Boolean"},
    "count": {"3.0": "UInt64", "2.0": "Integer"},
}


@dataclass(frozen=True, repr=False)
class UnitVariable(Displayed):
    """A variable of a functional mock-up unit (FMU)."""

    name: str  # structured name, as FMI defines it
    reference: int  # value reference
    # type of the value: a real number, a Boolean, or a counter that never decreases
    kind: Literal["number", "truth", "count"]
    causality: Literal["independent", "input", "output"]  # independent, input or output
    text: str  # description of the variable
    start: float = 0.0  # value of an input before it is set; 0 of a truth value is false
    unit: str = ""  # unit of the value; empty if it is not known


def used_links(loop: Loop) -> tuple[str, ...]:
    """Return the links between nodes on which the policy sends packets, in the order of their numbers."""
    found: set[str] = {step.link for step in loop.policy.steps if isinstance(step, Send)}
    return tuple(link for link in wire_links(loop.policy) if link in found)


def references(loop: Loop) -> dict[str, int]:
    """Return, by name, the FMI value reference at which the FMU's variables of that name begin."""
    codes = len(wire_links(loop.policy))
    blocks = -(-codes // 16) * 16  # references of the links by name
    y = 1024 * (1 + 3 * blocks // 1024)
    return {
        "time": 0, "degraded": 1, "lost": 16, "sent": 16 + blocks, "sends": 16 + 2 * blocks, "y": y,
        "u": y + 1024 * (1 + loop.policy.model.outputs // 1024),
        "silence": y + 1024 * (2 + loop.policy.model.outputs // 1024 + loop.policy.model.inputs // 1024),
        "missing": y + 1024 * (3 + loop.policy.model.outputs // 1024 + loop.policy.model.inputs // 1024),
        "late": y + 1024 * (4 + 2 * (loop.policy.model.outputs // 1024) + loop.policy.model.inputs // 1024),
    }  # fmt: skip


def tick_length(loop: Loop) -> float:
    """Return the duration of a step in seconds; 1 if the problem does not specify it."""
    return loop.problem.plant.dt or 1.0


def may_lose(loop: Loop) -> bool:
    """Return whether the network of the loop can drop packets."""
    return loop.network.protocol != "ideal"


def starts(loop: Loop) -> list[float]:
    """Return the start values of the FMU's inputs: 0 for a measurement, and the problem's set-point for a set-point."""
    model = loop.in_units.policy.model
    return [0.0] * model.sensed + model.given.tolist() if model.set_points else [0.0] * model.sensed


def list_variables(loop: Loop) -> tuple[UnitVariable, ...]:
    """Return all variables of the FMU for a loop's policy, except the variable of time."""
    links, first, model, codes = used_links(loop), references(loop), loop.policy.model, wire_links(loop.policy)
    predicts = loop.policy.prediction is not None  # the input of the plant is then u = L x̂
    applied, where = ("Predicted state", "of the actuator's model") if predicts else ("Input", "of the plant")
    outputs, inputs, aims = _labels(loop)
    found = [
        _named(
            UnitVariable(f"y[{i + 1}]", first["y"] + i, "number", "input", f"Measurement {i + 1} of the plant"), label
        )
        for i, label in enumerate(outputs)
    ]
    found += [
        _named(
            UnitVariable(f"setpoint[{i + 1}]", first["y"] + model.sensed + i, "number", "input", "Set-point", start),
            label,
        )
        for i, (start, label) in enumerate(zip(starts(loop)[model.sensed :], aims, strict=True))
    ]
    found += [
        UnitVariable(
            f"missing[{i + 1}]",
            first["missing"] + i,
            "truth",
            "input",
            f"Measurement {i + 1} of the next step is missing",
        )
        for i in range(model.sensed)
    ]
    if may_lose(loop):
        found += [
            UnitVariable(
                f"lost_{identifier(link)}", first["lost"] + codes.index(link), "truth", "input",
                f"A packet that is sent on the {link} link in the next step is dropped",
            )
            for link in links
        ]  # fmt: skip
    found += [
        UnitVariable(
            f"late_{identifier(link)}", first["late"] + codes.index(link), "number", "input",
            f"Steps after which a packet arrives that is sent on the {link} link in the next step",
        )
        for link in links if link in loop.network.late
    ]  # fmt: skip
    found += [
        _named(UnitVariable(f"u[{i + 1}]", first["u"] + i, "number", "output", f"{applied} {i + 1} {where}"), label)
        for i, label in enumerate(inputs)
    ]
    for link in links:
        found += [
            UnitVariable(
                f"sent_{identifier(link)}", first["sent"] + codes.index(link), "truth", "output",
                f"A packet was sent on the {link} link in the last step",
            ),
            UnitVariable(
                f"sends_{identifier(link)}", first["sends"] + codes.index(link), "count", "output",
                f"Number of packets sent on the {link} link so far",
            ),
        ]  # fmt: skip
    found += [
        UnitVariable(
            f"silence_{links}", first["silence"] + i, "number", "output",
            "Sum of what silence adds to the cost of its own response, in the unit of the cost times that of the time",
        )
        for i, (links, _) in enumerate(_silences(loop))
    ]  # fmt: skip
    what = "An assumption of the theory of the policy was violated, for example by an unexpected packet loss"
    return (*found, UnitVariable("degraded", first["degraded"], "truth", "output", what))


def _labels(loop: Loop) -> tuple[list[str], list[str], list[str]]:
    """Return the labels of measurements, inputs and set-points, which are empty for signals without names."""
    model, names = loop.policy.model, loop.names or Names()
    role: Role = "inputs" if loop.policy.prediction is None else "states"
    sizes: list[tuple[Role, int]] = [("outputs", model.sensed), (role, model.inputs)]
    outputs, inputs = (names.labels(which, [""] * size) for which, size in sizes)
    source, aims = loop.problem.source, [""] * model.set_points
    if names and source is not None and source.exosystem is not None and len(source.exosystem.outputs) == len(aims):
        aims = [*names.quantities(source.exosystem.outputs, source.C)]
    return outputs, inputs, aims


def _named(one: UnitVariable, label: str) -> UnitVariable:
    """Return a variable with the name of its signal in its description, and with its unit."""
    name, unit = unit_of(label) if not label.startswith("(") else ("", label[1:-1])
    return replace(one, text=f"{one.text}: {name}" if name else one.text, unit=unit)


def _silences(loop: Loop) -> list[tuple[str, str]]:
    """Return the links that nodes decide, as an identifier, each with the role of the node that decides."""
    return [
        (
            name_of_links(links),
            next(role for role in roles(loop.policy) if one.at in place_of(loop.policy, role)),
        )
        for links, one in loop.policy.theory.silence.items()
    ]


def describe_unit(loop: Loop, name: str, version: Version, token: str, sources: tuple[str, ...], ticks: int) -> bytes:
    """Return the XML file that describes the variables of an FMU (``modelDescription.xml``)."""
    tick, variables = tick_length(loop), list_variables(loop)
    new = version == "3.0"
    root = Xml.Element("fmiModelDescription", {
        "fmiVersion": version, "modelName": name, "instantiationToken" if new else "guid": token,
        "description": f"Event-triggered policy of kind {loop.policy.kind}, one sampling period per step",
        "generationTool": f"taciturn {__version__}", "variableNamingConvention": "structured",
    })  # fmt: skip
    capabilities = {"modelIdentifier": name, "canHandleVariableCommunicationStepSize": "false"}
    capabilities |= {f"canGetAndSetFMU{'State' if new else 'state'}": "true"}
    capabilities |= {f"canSerializeFMU{'State' if new else 'state'}": "true"}
    if new:
        Xml.SubElement(root, "CoSimulation", {**capabilities, "fixedInternalStepSize": repr(tick)})
    else:
        unit = Xml.SubElement(root, "CoSimulation", {**capabilities, "canNotUseMemoryManagementFunctions": "true"})
        listed = Xml.SubElement(unit, "SourceFiles")
        for source in sources:
            Xml.SubElement(listed, "File", {"name": source})
    units = dict.fromkeys(one.unit for one in variables if one.unit)
    if units:
        defined = Xml.SubElement(root, "UnitDefinitions")
        for one in units:
            Xml.SubElement(defined, "Unit", {"name": one})
    categories = Xml.SubElement(root, "LogCategories")
    Xml.SubElement(categories, "Category", {"name": "logStatusError", "description": "Reasons why a call was rejected"})
    Xml.SubElement(
        root, "DefaultExperiment", {"startTime": "0", "stopTime": repr(tick * ticks), "stepSize": repr(tick)}
    )
    _list(root, variables, version, references(loop)["time"])
    _structure(root, variables, version)
    return _text(root)


def describe_build(name: str, sources: tuple[str, ...]) -> bytes:
    """Return the XML file that describes how to compile an FMU (``buildDescription.xml`` of FMI 3.0)."""
    root = Xml.Element("fmiBuildDescription", {"fmiVersion": "3.0"})
    build = Xml.SubElement(root, "BuildConfiguration", {"modelIdentifier": name})
    listed = Xml.SubElement(build, "SourceFileSet", {"language": "C99"})
    for source in sources:
        Xml.SubElement(listed, "SourceFile", {"name": source})
    return _text(root)


def _list(root: Xml.Element, variables: tuple[UnitVariable, ...], version: Version, time: int) -> None:
    listed = Xml.SubElement(root, "ModelVariables")
    if version == "3.0":
        said = {"name": "time", "valueReference": str(time), "causality": "independent"}
        Xml.SubElement(listed, "Float64", {**said, "variability": "continuous", "description": "Time in seconds"})
    for one in variables:
        said = {
            "name": one.name, "valueReference": str(one.reference), "description": one.text,
            "causality": one.causality, "variability": "discrete",
        }  # fmt: skip
        start = {"unit": one.unit} if one.unit else {}
        start |= {"start": "false" if one.kind == "truth" else repr(one.start)} if one.causality == "input" else {}
        initial = {"initial": "calculated"} if one.causality == "output" else {}
        if version == "3.0":
            Xml.SubElement(listed, _TYPES[one.kind][version], {**said, **initial, **start})
        else:
            Xml.SubElement(
                Xml.SubElement(listed, "ScalarVariable", {**said, **initial}), _TYPES[one.kind][version], start
            )


def _structure(root: Xml.Element, variables: tuple[UnitVariable, ...], version: Version) -> None:
    """List the outputs without dependencies: only a step changes them, so they do not depend on current inputs."""
    structure = Xml.SubElement(root, "ModelStructure")
    for old, new in (("Outputs", "Output"), ("InitialUnknowns", "InitialUnknown")):
        parent = structure if version == "3.0" else Xml.SubElement(structure, old)
        for i, one in enumerate(variables, start=1):
            if one.causality != "output":
                continue
            if version == "3.0":
                Xml.SubElement(parent, new, {"valueReference": str(one.reference), "dependencies": ""})
            else:
                Xml.SubElement(parent, "Unknown", {"index": str(i), "dependencies": ""})


def _text(root: Xml.Element) -> bytes:
    Xml.indent(root)
    return Xml.tostring(root, encoding="UTF-8", xml_declaration=True) + b"\n"


UNIT_COVERAGE = Coverage(LOOPS | LATE, "a functional mock-up unit does not carry out")
UNIT = ("fmu.h", "fmu.c")
HEADERS: Mapping[Version, tuple[str, ...]] = {
    "3.0": ("fmi3PlatformTypes.h", "fmi3FunctionTypes.h", "fmi3Functions.h"),
    "2.0": ("fmi2TypesPlatform.h", "fmi2FunctionTypes.h", "fmi2Functions.h"),
}
SHARED = "-fPIC -shared -fvisibility=hidden"  # exports only the functions of FMI
_SYSTEMS = {"Linux": ("linux", ".so"), "Darwin": ("darwin", ".dylib"), "Windows": ("windows", ".dll")}
_MACHINES = {"x86_64": "x86_64", "amd64": "x86_64", "aarch64": "aarch64", "arm64": "aarch64"}
_OLD = {"x86_64-linux": "linux64", "x86_64-darwin": "darwin64", "x86_64-windows": "win64"}  # names in FMI 2.0
_DAY = (1980, 1, 1, 0, 0, 0)  # date of every file in the archive: the earliest that the format allows
_PATIENCE = 600.0  # time limit of the compiler in seconds


def _unit(found: Fmu) -> str:
    return f"FMI {found.version}, co-simulation, of {' and '.join(node.role for node in found.nodes)}"


@dataclass(frozen=True, eq=False, repr=False)
class Fmu(Result):
    """A functional mock-up unit.

    Args:
        name: name of the model.
        kind: kind of the policy.
        version: version of FMI.
        token: unique identifier, which depends on the policy and on the sources of the unit.
        nodes: all nodes of the policy, which the unit contains.
        files: contents of the archive, by path.
        binary: path of the compiled library in the archive, or None if there is none.
        notes: notes for the user.
    """

    FIELDS: ClassVar[tuple[Field[Fmu], ...]] = (
        VERDICT,
        Field("kind", key="policy", say="policy"),
        Field("name"),
        Field("version", key="fmi", say="unit", text=_unit),
        Field("token"),
        Field("nodes", json=lambda nodes: [node.role for node in nodes]),
        Field("binary", say="binary", none="none"),
        Field("files", json=sorted, say="file", text=lambda found: sorted(found.files), part="method"),
        Field("notes", say="note"),
    )

    name: str
    kind: str
    version: Version
    token: str
    nodes: tuple[CNode, ...]
    files: Mapping[str, bytes]
    binary: str | None
    notes: tuple[str, ...]

    @property
    def verdict(self) -> tuple[str, ...]:
        """Sentence that names the exported nodes and says whether the FMU runs without a compiler."""
        needs = "its sources need a compiler" if self.binary is None else "it has a binary for this processor"
        return (f"an FMU of {' and '.join(node.role for node in self.nodes)}; {needs}",)

    def archive(self) -> bytes:
        """Return the bytes of the FMU file; they depend on nothing but the contents of the files in it."""
        buffer = BytesIO()
        with zipfile.ZipFile(buffer, "w") as held:
            for path in sorted(self.files, key=lambda path: (path != "modelDescription.xml", path)):
                entry = zipfile.ZipInfo(path, _DAY)
                entry.compress_type, entry.create_system, entry.external_attr = zipfile.ZIP_DEFLATED, 3, 0o644 << 16
                held.writestr(entry, self.files[path])
        return buffer.getvalue()

    def write(self, path: Path) -> None:
        """Write the unit.

        Raises:
            ProblemError: the name does not end in ``.fmu``, or the file cannot be written.
        """
        check_name(path)
        try:
            write_whole(path, self.archive())
        except OSError as error:
            reason = error.strerror or str(error)
            raise ProblemError(
                f"the file {path} cannot be written ({reason}); expected a path with write permission"
            ) from None


def check_name(path: Path) -> None:
    """Raise an error if the name of an FMU file does not end in ``.fmu``."""
    if path.suffix != ".fmu":
        raise ProblemError(f"the file name of the FMU is {path}; expected a name that ends in .fmu")


def print_fmu(
    loop: Loop,
    name: str,
    *,
    version: Version = "3.0",
    seed: int = 0,
    compiler: str | None = "cc",
) -> Fmu:
    """Return the functional mock-up unit (FMU) for a loop's policy.

    The unit contains all nodes. In each step, which is one sampling period, they receive packets, execute a step and
    send packets. Inputs are the measurements ``y[i]``, ``missing[i]`` for those that are not measured and, if the
    network may drop packets, ``lost_LINK``. Outputs are ``u[i]``, ``sent_LINK``, ``sends_LINK`` and ``degraded``, and
    ``silence_LINKS`` if the nodes add up the cost of their silence.

    Args:
        loop: loop with plant, policy and network; it also sets the precision of the nodes.
        name: a C identifier.
        version: version of FMI.
        seed: seed of the random numbers of the policy.
        compiler: compiler that builds a binary for this machine; without a compiler the unit contains only sources.

    Returns:
        The unit; a note gives the reason if it has no binary.

    Raises:
        ProblemError: the nodes cannot be separated or are too large, FMI has no such version, or the name is not an
            identifier.

    Example:
        >>> import taciturn
        >>> problem = taciturn.load("two-mass")
        >>> unit = print_fmu(problem.close(problem.design()), "two_mass", compiler=None)
        >>> [path for path in unit.files if path.startswith("binaries")], unit.notes[0][:22]
        ([], 'the unit has no binary')
    """
    if version not in HEADERS:
        raise ProblemError(f"the version of FMI is {version!r}; expected '3.0' or '2.0'")
    if not (name.isidentifier() and name.isascii()):
        raise ProblemError(f"the name of the FMU is {name!r}; expected a C identifier such as two_mass")
    UNIT_COVERAGE.check(loop.parts, loop.policy.designed_for)
    if loop.network.cuts(loop.policy.tick):
        keys = ", ".join(loop.network.key(link, "delay") for link in loop.network.late)
        raise ProblemError(
            f"{keys}: packets may arrive within a period, so that the input of the plant changes within a step of a "
            "functional mock-up unit, which has one input per step; expected delays of whole periods, or a buffer"
        )
    folder = print_folder(loop, name, seed=seed)
    own = [file for node in folder.nodes for file in (f"{node.name}.h", f"{node.name}.c")]
    texts = {file: folder.files[file] for file in (*CORE, *EXCHANGE, "taciturn_config.h", *own)}
    core = files("taciturn_export") / "core"
    for file in (*UNIT, f"fmi{version[0]}.c"):
        texts[file] = (core / file).read_text(encoding="utf-8")
    texts["fmu_data.c"] = _print_start(folder.nodes, loop)
    told = repr((tick_length(loop), sorted(texts.items())))
    digest = hashlib.blake2s(told.encode(), digest_size=16).hexdigest()
    token = f"{{{fingerprint(loop.policy, loop.network):016x}-{digest}}}"
    texts["fmu_data.h"] = _print_data(folder.nodes, loop, token, digest)
    compiled = tuple(sorted(file for file in texts if file.endswith(".c")))
    ticks = min(ROWS, loop.horizon or ROWS)
    held = {
        "modelDescription.xml": describe_unit(loop, name, version, token, compiled, ticks),
        "documentation/index.html": _print_page(loop, name).encode(),
        "documentation/licenses/license.txt": _LICENSES.encode(),
        "documentation/licenses/apache-2.0.txt": (core / "LICENSE").read_bytes(),
        "documentation/licenses/fmi.txt": (files("taciturn_export") / "fmi" / "LICENSE").read_bytes(),
        **{f"sources/{file}": text.encode() for file, text in texts.items()},
    }
    if version == "3.0":
        held["sources/buildDescription.xml"] = describe_build(name, compiled)
    place, notes = None, tuple[str, ...]()
    try:
        place = _place(name, version, compiler)
        held[place] = _compile(texts, compiled, version, compiler or "")
    except _NoBinaryError as reason:
        place, told = None, "the importing simulator compiles the sources, or `fmpy compile` does"
        notes = (f"the unit has no binary because {reason}: {told}",)
    return Fmu(name, folder.kind, version, token, folder.nodes, held, place, notes)


class _NoBinaryError(Exception):
    """The unit cannot contain a binary; the message gives the reason."""


def _place(name: str, version: Version, compiler: str | None) -> str:
    """Return the path in the archive for the binary of this machine."""
    system, ending = _SYSTEMS.get(platform.system(), ("", ""))
    machine = _MACHINES.get(platform.machine().lower(), "")
    found = f"{machine}-{system}" if version == "3.0" else _OLD.get(f"{machine}-{system}", "")
    if compiler is None:
        raise _NoBinaryError("none was requested")
    if shutil.which(compiler) is None:
        raise _NoBinaryError(f"this machine has no compiler {compiler!r}")
    if not (system and machine and found):
        raise _NoBinaryError(f"FMI {version} defines no folder name for {platform.system()} on {platform.machine()}")
    return f"binaries/{found}/{name}{ending}"


def _compile(texts: Mapping[str, str], compiled: tuple[str, ...], version: Version, compiler: str) -> bytes:
    """Compile the sources, and return the shared library."""
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder)
        (place / "fmi").mkdir()
        for file in HEADERS[version]:
            (place / "fmi" / file).write_bytes((files("taciturn_export") / "fmi" / file).read_bytes())
        for file, text in texts.items():
            (place / file).write_text(text, encoding="utf-8")
        command = [compiler, *FLAGS.split(), *SHARED.split(), "-isystem", "fmi", "-o", "unit", *compiled]
        try:
            done = subprocess.run(
                command,
                cwd=place,
                capture_output=True,
                encoding="utf-8",
                errors="replace",
                timeout=_PATIENCE,
                check=False,
            )
        except (OSError, subprocess.TimeoutExpired) as error:
            raise _NoBinaryError(f"{compiler} does not finish ({error})") from None
        if done.returncode != 0:
            first = next((line for line in done.stderr.splitlines() if "error" in line), done.stderr.strip())
            raise _NoBinaryError(f"{compiler} rejects the sources ({first})")
        if not (place / "unit").exists():
            raise _NoBinaryError(f"{compiler} has written no file")
        return (place / "unit").read_bytes()


def _print_start(nodes: tuple[CNode, ...], loop: Loop) -> str:
    """Return C source of the function that starts the nodes, and of the list of links."""
    used, links = used_links(loop), wire_links(loop.policy)[: core_links(loop.policy)]
    outputs, inputs = entries_of_nodes(loop.policy, loop.network)
    lines = [f'{GENERATED_BY}: start of the nodes of a unit. Do not edit. */\n#include "fmu_data.h"\n']
    late = ", ".join(_truth(link in used and link in loop.network.late) for link in links)
    lines += [f"const bool fmu_delays[] = {{{late}}};"]
    lines += [f"const bool fmu_links[] = {{{', '.join(_truth(link in used) for link in links)}}};"]
    lines += [
        f"const unsigned fmu_{name}[] = {{{', '.join(f'{i}U' for i in places)}}};"
        for name, places in {"outputs": outputs, "inputs": inputs}.items()
    ]
    begun = ", ".join(c_literal(value, "float64") for value in starts(loop))
    lines += [f"const double fmu_starts[] = {{{begun}}};"]
    lines += [f"const bool fmu_lossy = {_truth(may_lose(loop))};\n"]
    lines += ["size_t fmu_start(fmu_memory *memory, tac_node **nodes) {", "  const tac_key none = {NULL, 0U};"]
    lines += [f"  nodes[{i}] = {node.name}_start(&memory->{node.name}, 0U, 0U, none);" for i, node in enumerate(nodes)]
    whole = " && ".join(f"nodes[{i}] != NULL" for i in range(len(nodes)))
    lines += [f"  return ({whole}) ? {len(nodes)}U : 0U;", "}", ""]
    named = {node.role: node.name for node in nodes}
    lines += ["double fmu_silence(const fmu_memory *memory, uint32_t number) {", "  double found = 0.0;"]
    lines += [
        f"  if (number == {i}U) {{\n    found = (double){named[role]}_silence_{links}(&memory->{named[role]});\n  }}"
        for i, (links, role) in enumerate(_silences(loop))
    ]
    return "\n".join(
        [*lines, *([] if _silences(loop) else ["  (void)memory;", "  (void)number;"]), "  return found;", "}", ""]
    )


def _print_data(nodes: tuple[CNode, ...], loop: Loop, token: str, digest: str) -> str:
    """Return a C header with the token of the unit, the references of its variables, and the memory of its nodes."""
    return _DATA.format(
        mark=GENERATED_BY, token=token, stamp=digest[:16], tick=c_literal(tick_length(loop), "float64"),
        silences=len(loop.policy.theory.silence),
        measured=loop.policy.model.outputs, sensed=loop.policy.model.sensed, applied=loop.policy.model.inputs,
        references="\n".join(f"#define FMU_{name.upper()} {first}U" for name, first in references(loop).items()),
        headers="\n".join(f'#include "{node.name}.h"' for node in nodes),
        memory="\n".join(f"  {node.name} {node.name};" for node in nodes),
    )  # fmt: skip


def _print_page(loop: Loop, name: str) -> str:
    rows = "\n".join(
        f"<tr><td>{one.name}</td><td>{one.causality}</td><td>{escape(one.text)}</td></tr>"
        for one in list_variables(loop)
    )
    return _PAGE.format(name=name, kind=escape(loop.policy.kind), tick=tick_length(loop), rows=rows)


def _truth(value: bool) -> str:
    return "true" if value else "false"


_DATA = """{mark}: the data of a unit. Do not edit. */
#ifndef FMU_DATA_H
#define FMU_DATA_H

{headers}

#define FMU_TOKEN "{token}"
#define FMU_STAMP UINT64_C(0x{stamp})
#define FMU_TICK {tick}    /* seconds */
#define FMU_SENSED {sensed}     /* measurements of the plant */
#define FMU_MEASURED {measured} /* with the set-points after them */
#define FMU_APPLIED {applied}
#define FMU_SILENCES {silences}U /* nodes that add up what their silence costs */

/* value references; for an array, the reference of the first entry */
{references}

typedef struct {{
{memory}
}} fmu_memory;

extern const bool fmu_links[]; /* whether packets are sent over each link */
extern const bool fmu_delays[]; /* whether each link delays packets at random */
extern const bool fmu_lossy;   /* whether packets may be dropped */
extern const double fmu_starts[]; /* measurements and set-points until they are set */
extern const unsigned fmu_outputs[]; /* output of the plant of each measurement, in the order of the nodes */
extern const unsigned fmu_inputs[];  /* input of the plant of each input, in the order of the nodes */

/* Start the nodes, and return their number; 0: the data of a node are damaged. */
size_t fmu_start(fmu_memory *memory, tac_node **nodes);

/* Return what the silence of a node has cost since it started, by the number of the node among those that decide. */
double fmu_silence(const fmu_memory *memory, uint32_t number);

#endif
"""
_PAGE = """<!DOCTYPE html>
<html lang="en">
<head><meta charset="utf-8"><title>{name}</title></head>
<body>
<h1>{name}</h1>
<p>This unit contains all nodes of a policy of kind {kind}, which exchange packets inside the unit. Each step must be
one sampling period of {tick:g} seconds, and must begin at the end of the last step.</p>
<p>Before a step, set the measurement at the time at which the step begins. After the step, read the input of the plant.
For control without delay apply this input from the beginning of the step: step this unit first, and then the plant over
the same time.</p>
<table>
<tr><th>variable</th><th>causality</th><th>description</th></tr>
{rows}
</table>
</body>
</html>
"""
_LICENSES = """The sources in this unit, and binaries made from them, are parts of taciturn.
Their licence is Apache-2.0, in apache-2.0.txt.
The library is compiled with the header files of FMI, which are under the 2-clause BSD licence, in fmi.txt.
The generated files belong to the designer of the policy.
"""
