"""The model description of a functional mock-up unit: its variables and the XML files that list them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal
from xml.etree import ElementTree as Xml

from taciturn._display import Displayed
from taciturn._version import __version__
from taciturn.export.node import identifier
from taciturn.loop import Loop
from taciturn.model.places import wire_links
from taciturn.model.policy import Send

Version = Literal["3.0", "2.0"]
_TYPES = {
    "number": {"3.0": "Float64", "2.0": "Real"},
    "truth": {"3.0": "Boolean", "2.0": "Boolean"},
    "count": {"3.0": "UInt64", "2.0": "Integer"},
}


@dataclass(frozen=True, repr=False)
class UnitVariable(Displayed):
    """A variable of a functional mock-up unit (FMU).

    Args:
        name: structured name, as FMI defines it.
        reference: value reference.
        kind: type of the value: a real number, a Boolean, or a counter that never decreases.
        causality: independent, input or output.
        text: description of the variable.
        start: value of an input before it is set; 0 of a truth value is false.
    """

    name: str
    reference: int
    kind: Literal["number", "truth", "count"]
    causality: Literal["independent", "input", "output"]
    text: str
    start: float = 0.0


def used_links(loop: Loop) -> tuple[str, ...]:
    """Return the links between nodes over which packets are sent, in the order of their numbers."""
    found: set[str] = {step.link for step in loop.policy.steps if isinstance(step, Send)}
    return tuple(link for link in wire_links(loop.policy) if link in found)


def references(loop: Loop) -> dict[str, int]:
    """Return the value reference of each variable, or of the first variable of each name."""
    codes = len(wire_links(loop.policy))
    blocks = -(-codes // 16) * 16  # references of the links by name
    y = 1024 * (1 + 3 * blocks // 1024)
    return {
        "time": 0, "degraded": 1, "lost": 16, "sent": 16 + blocks, "sends": 16 + 2 * blocks, "y": y,
        "u": y + 1024 * (1 + loop.policy.model.outputs // 1024),
    }  # fmt: skip


def tick_length(loop: Loop) -> float:
    """Return the length of a step in seconds, or 1 if the problem does not specify one."""
    return loop.problem.plant.dt or 1.0


def may_lose(loop: Loop) -> bool:
    """Return whether the network of the loop may drop packets."""
    return loop.network.protocol != "ideal"


def starts(loop: Loop) -> list[float]:
    """Return the start values of the measurements, and of the set-points after them: those that the problem states."""
    model = loop.in_units.policy.model
    return [0.0] * model.sensed + model.given.tolist() if model.set_points else [0.0] * model.sensed


def list_variables(loop: Loop) -> tuple[UnitVariable, ...]:
    """Return the variables of the FMU for the policy of a loop, except the time."""
    links, first, model, codes = used_links(loop), references(loop), loop.policy.model, wire_links(loop.policy)
    predicts = loop.policy.prediction is not None  # the input of the plant is then u = L x̂
    applied, where = ("Predicted state", "of the actuator's model") if predicts else ("Input", "of the plant")
    found = [
        UnitVariable(f"y[{i + 1}]", first["y"] + i, "number", "input", f"Measurement {i + 1} of the plant")
        for i in range(model.sensed)
    ]
    found += [
        UnitVariable(f"setpoint[{i - model.sensed + 1}]", first["y"] + i, "number", "input", "Set-point", start)
        for i, start in enumerate(starts(loop))
        if i >= model.sensed
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
        UnitVariable(f"u[{i + 1}]", first["u"] + i, "number", "output", f"{applied} {i + 1} {where}")
        for i in range(model.inputs)
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
    what = "An assumption of the theory of the policy was violated, for example by an unexpected packet loss"
    return (*found, UnitVariable("degraded", first["degraded"], "truth", "output", what))


def describe_unit(loop: Loop, name: str, version: Version, token: str, sources: tuple[str, ...], ticks: int) -> bytes:
    """Return the XML model description of a functional mock-up unit.

    Args:
        loop: loop whose policy the unit contains.
        name: name of the model and of its files.
        version: version of FMI.
        token: unique identifier of the unit.
        sources: names of the files to compile.
        ticks: length of the default experiment in steps.
    """
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
    categories = Xml.SubElement(root, "LogCategories")
    Xml.SubElement(categories, "Category", {"name": "logStatusError", "description": "Reasons why a call was rejected"})
    Xml.SubElement(
        root, "DefaultExperiment", {"startTime": "0", "stopTime": repr(tick * ticks), "stepSize": repr(tick)}
    )
    _list(root, variables, version, references(loop)["time"])
    _structure(root, variables, version)
    return _text(root)


def describe_build(name: str, sources: tuple[str, ...]) -> bytes:
    """Return the XML build description of a functional mock-up unit for FMI 3.0."""
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
        start = {"start": "false" if one.kind == "truth" else repr(one.start)} if one.causality == "input" else {}
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
