"""Makes functional mock-up units, and steps them with FMPy: the same for both versions of FMI."""

from __future__ import annotations

import shutil
import subprocess
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar

import fmpy
import numpy as np
from export.devices import HERE, needs_compiler
from fmpy.simulation import instantiate_fmu

import taciturn_export
from taciturn.loop import Loop
from taciturn.model.packets import wire_links
from taciturn.program import numpy as interpreter
from taciturn.program.draws import UNIFORM, draw_uniforms, seed_generators
from taciturn.program.machine import Kernel
from taciturn.program.ops import Entry
from taciturn_export.fmu import Fmu, Version, may_lose, print_fmu, tick_length
from taciturn_export.folder import RecordedRun, drawn_by_the_policy, record_loop
from taciturn_export.node import identifier

FMI = Path(taciturn_export.__file__).parent / "fmi"
SEED = 3
_TYPES = {"Float64": "Float64", "Real": "Real", "Boolean": "Boolean", "UInt64": "UInt64", "Integer": "Integer"}


class Instance:
    """An instance of a unit in a folder.

    Args:
        messages: what all of them said. FMPy hands what units of FMI 2.0 say to the newest instance.
    """

    messages: ClassVar[list[str]] = []

    def __init__(self, folder: Path, token: str = "") -> None:
        """Load its library and instantiate it."""
        self.described = fmpy.read_model_description(str(folder))
        if token:
            self.described.guid = self.described.instantiationToken = token
        self.new = self.described.fmiVersion == "3.0"
        self._of = {one.name: (one.valueReference, _TYPES[one.type]) for one in self.described.modelVariables}
        self.fmu: Any = instantiate_fmu(str(folder), self.described, "CoSimulation", logger=self._hear)

    def _hear(self, *told: Any) -> None:
        self.messages.append(told[-1].decode() if isinstance(told[-1], bytes) else str(told[-1]))

    def start(self, time: float = 0.0) -> Instance:
        """Initialize it."""
        if self.new:
            self.fmu.enterInitializationMode(startTime=time)
        else:
            self.fmu.setupExperiment(startTime=time)
            self.fmu.enterInitializationMode()
        self.fmu.exitInitializationMode()
        return self

    def set(self, values: Mapping[str, Any]) -> None:
        """Write variables."""
        for name, value in values.items():
            reference, kind = self._of[name]
            getattr(self.fmu, f"set{kind}")([reference], [value])

    def get(self, *names: str) -> list[Any]:
        """Read variables."""
        return [getattr(self.fmu, f"get{kind}")([reference])[0] for reference, kind in map(self._of.__getitem__, names)]

    def step(self, time: float, step: float) -> None:
        """Make a step."""
        self.fmu.doStep(currentCommunicationPoint=time, communicationStepSize=step)

    def told(self, action: str, *arguments: Any) -> Any:
        """Call what the versions spell differently."""
        return getattr(self.fmu, action if self.new else action.replace("State", "state"))(*arguments)

    def close(self) -> None:
        """End it."""
        self.fmu.freeInstance()


def make_unit(loop: Loop, folder: Path, version: Version = "3.0", seed: int = SEED) -> Fmu:
    """Make a unit with a binary, write it next to a folder, and unpack it there."""
    unit = print_fmu(loop, "unit", version=version, seed=seed, compiler=needs_compiler())
    path = folder.with_suffix(".fmu")
    unit.write(path)
    shutil.unpack_archive(path, folder, "zip")
    return unit


def record(loop: Loop, ticks: int, seed: int = SEED) -> RecordedRun:
    """Run a loop whose policy draws what its nodes draw of themselves."""
    ticks = min(ticks, loop.horizon or ticks)
    own = drawn_by_the_policy(loop.open_program())
    if not own:
        return record_loop(loop, ticks, seed)
    drawing = draw_uniforms(len(own), loop.precision)
    run = Kernel(drawing, "parity").run if ticks > 1000 else interpreter.run
    drawn = run(drawing, seed_generators(SEED, 1), ticks).outputs
    return record_loop(loop, ticks, seed, np.array([drawn[Entry(UNIFORM, i)][:, 0] for i in range(len(own))]).T)


def given(loop: Loop, vector: RecordedRun, tick: int) -> dict[str, Any]:
    """Return the inputs of a unit in a step."""
    p = loop.policy.model.sensed  # then come the set-points
    names = [f"y[{i + 1}]" if i < p else f"setpoint[{i + 1 - p}]" for i in range(loop.policy.model.outputs)]
    told = vector.measured[tick]
    values: dict[str, Any] = dict(zip(names, map(float, np.nan_to_num(told)), strict=True))
    values |= {f"missing[{i + 1}]": bool(np.isnan(told[i])) for i in range(p)}
    if may_lose(loop):
        values |= {f"lost_{identifier(link)}": not vector.arrived[tick, i] for i, link in enumerate(vector.links)}
    late = [(i, link) for i, link in enumerate(vector.links) if link in loop.network.late]
    values |= {f"late_{identifier(link)}": max(float(vector.arrived[tick, i]) - 1.0, 0.0) for i, link in late}
    return values


def differing_ticks(instance: Instance, loop: Loop, vector: RecordedRun, ticks: Iterable[int]) -> list[int]:
    """Step an instance, and return the steps in which a decision or a bit of the input differs."""
    wrong, seconds = list[int](), tick_length(loop)
    inputs = [f"u[{i + 1}]" for i in range(vector.applied.shape[1])]
    for tick in ticks:
        instance.set(given(loop, vector, tick))
        instance.step(tick * seconds, seconds)
        applied = np.array(instance.get(*inputs), dtype=np.float64)
        sent = [bool(value) for value in instance.get(*(f"sent_{identifier(link)}" for link in vector.links))]
        same = applied.tobytes() == vector.applied[tick].astype(np.float64).tobytes()
        if not same or sent != [value > 0 for value in vector.sent[tick]]:
            wrong.append(tick)
    return wrong


def build_driver(folder: Path, *options: str) -> Path:
    """Compile the program that steps units through files."""
    made = folder / "drive"
    command = [needs_compiler(), "-std=c99", "-O2", *options, f"-I{FMI}", str(HERE / "drive.c"), "-o", str(made)]
    subprocess.run([*command, "-ldl"], check=True)
    return made


def drive(driver: Path, library: Path, unit: Fmu, loop: Loop, vector: RecordedRun) -> int:
    """Step a library through rows; return how many steps agree."""
    rows = library.parent / "rows"
    np.hstack([vector.measured, 1 - vector.arrived, vector.sent, vector.applied]).astype(np.float64).tofile(rows)
    sizes: Sequence[object] = (int(may_lose(loop)), vector.measured.shape[1], vector.applied.shape[1])
    links = [str(wire_links(loop.policy).index(link)) for link in vector.links]
    command = [driver, library, unit.token, repr(tick_length(loop)), rows, *map(str, sizes), *links]
    done = subprocess.run(list(map(str, command)), capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    return int(done.stdout)
