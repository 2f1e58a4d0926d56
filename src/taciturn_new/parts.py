"""Questions about optional parts of a problem: wireless nodes, losses, batteries, set-points, disturbances, limits.

One question lists the parts, and questions about the named ones follow in the order of the list. The answers are tables
of the problem file in the draft. Sensors and actuators that are not wireless are nodes at the controller's place.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, cast

import numpy as np

from taciturn.extend import Array
from taciturn_new.draft import Draft
from taciturn_new.matrices import parse_indices, parse_numbers
from taciturn_new.questions import Questions
from taciturn_new.readers import (
    ALL,
    NONE,
    a_number,
    deviations,
    indices,
    limits,
    node_names,
    numbers,
    some_of,
    timetable,
)

TAKEN = ("plant", "controller")  # names of nodes with another meaning


class Parts:
    """Questions about optional parts of a problem, such as packet losses, batteries, set-points and disturbances."""

    def __init__(self, questions: Questions, draft: Draft, folder: Path, ask_noise: Callable[[], None]) -> None:
        """Keep the draft that answers extend, the folder at which paths start, and how to ask for noise of outputs."""
        self.questions, self.draft, self.folder, self.ask_noise = questions, draft, folder, ask_noise
        self.parts = {
            "nodes": ("several wireless sensors or actuators, or only some of them wireless", self._ask_nodes),
            "losses": ("links that drop packets", self._ask_losses),
            "batteries": ("nodes with batteries", self._ask_batteries),
            "set-points": ("set-points that outputs follow", self._ask_set_points),
            "disturbances": ("a constant load, a ramp or a sinusoid that is to be compensated", self._ask_disturbances),
            "limits": ("limits of inputs or outputs", self._ask_limits),
        }

    def ask(self) -> None:
        """Ask which optional parts the problem has, then ask the questions about each of them."""
        self.questions.begin("Further parts")
        for i, (text, _) in enumerate(self.parts.values()):
            self.questions.say(text, f"{i + 1}  ")
        chosen = self.questions.ask(
            "the part",
            "Which of these does the problem have? Numbers, or none",
            some_of("the part", list(self.parts)),
            NONE,
            example="1 3",
            why="Questions about these parts follow. You can add other parts to the file later.",
        )
        self.draft.clear_parts()
        for name, (_, ask) in self.parts.items():
            if name in chosen:
                ask()

    def _ask_nodes(self) -> None:
        """Ask for the wireless nodes."""
        inputs, outputs = self.draft.counts
        self._ask_role("sensor", "measures", outputs, "output", "level")
        self._ask_role("actuator", "applies", inputs, "input", "valve")
        self.draft.nodes["controller"] = {"controls": True}

    def _ask_role(self, role: str, verb: str, size: int, signal: str, example: str) -> None:
        """Ask for the nodes of a role, and for the signals of each."""
        nodes = self.draft.nodes
        names = self.questions.ask(
            f"the {role}s",
            f"Wireless {role}s: their number, or names of your own; 0 if all are wired",
            node_names(role, int(role == "actuator" and not self.draft.remote_sensors), size, (*TAKEN, *nodes)),
            "1",
            example=example if size == 1 else f"{example}-1 {example}-2",
            why="Each wireless node has a link of its own. Other nodes are wired to the controller.",
        )
        left = list(range(size))
        for place, name in enumerate(names):
            usual = left if place == len(names) - 1 else left[:1]
            if len(names) == size or len(left) == 1:
                nodes[name] = {verb: usual}
            else:
                what = f"the {signal}s of {name}"
                nodes[name] = {
                    verb: self.questions.ask(
                        what, f"Numbers of {what}", indices(what, size), " ".join(str(i + 1) for i in usual)
                    )
                }
            left = [i for i in left if i not in nodes[name][verb]]
        if left:
            nodes[f"wired-{role}"] = {verb: left, "site": "controller"}

    def _ask_losses(self) -> None:
        """Ask for the share of packets that each link drops, and for acknowledgements."""
        draft = self.draft
        shares = {
            link: self.questions.ask(
                f"the loss of {link}",
                f"Share of the packets that the {link} link drops",
                a_number(f"the loss of {link}", 0.0, 1.0, closed=True),
                "0" if link == "sensor" and not draft.nodes else "0.1",
                example="0.2 for every fifth packet",
            )
            for link in draft.remote
        }
        told = self.questions.choose(
            "acknowledgements",
            "Does the receiver acknowledge each packet?",
            ("yes", "no"),
            "no",
            why="With acknowledgements, as in TCP, the sender learns which packets arrive; with UDP, it does not.",
        )
        for link, share in shares.items():
            if draft.nodes:
                draft.links |= {link: {"loss": share, "acknowledged": told == "yes"}} if share else {}
            else:
                draft.network |= {"protocol": "tcp" if told == "yes" else "udp", f"{link}_loss": share}

    def _ask_batteries(self) -> None:
        """Ask which nodes have a battery, for its energy, and for that of a packet."""
        ask, draft, links = self.questions.ask, self.draft, self.draft.remote
        if not links:
            self.questions.say("no node is wireless, so no link needs a battery")
            return
        chosen = ask(
            "the node with a battery",
            f"Which links have a battery at the sender or receiver: {', '.join(links)}",
            some_of("the node with a battery", links),
            ALL if draft.nodes else "actuator",
            why=(
                "The battery supplies the radio of the link: that of the sender, or of the receiver if it listens for "
                "packets. evaluate then prints the power of the packets, and how long the battery lasts."
            ),
        )
        energy = ask(
            "the energy of a packet",
            "Energy that a battery spends on a packet, in joules",
            a_number("the energy of a packet", 0.0),
            "0.0005",
            why="Current × voltage × time on air: 20 mA at 3 V for 8 ms are 0.0005 J.",
        )
        battery = ask(
            "the energy of a battery",
            "Energy in a battery, in joules",
            a_number("the energy of a battery", 0.0),
            "20000",
            why="Capacity × voltage × 3600: two AA cells of 2 Ah and 1.5 V have about 20,000 J.",
        )
        for link in chosen:
            if draft.nodes:
                draft.links.setdefault(link, {}).update(energy=energy, battery=battery)
            else:
                draft.network |= {f"{link}_energy": energy, f"{link}_battery": battery}

    def _ask_set_points(self) -> None:
        """Ask for set-points."""
        if self.draft.controller:
            self._ask_kept_set_points()
            return
        ask, draft = self.questions.ask, self.draft
        self._expect_noise("set-points")
        outputs = draft.counts[1]
        followed = ask(
            "the outputs",
            "Numbers of the outputs that follow a set-point, or all",
            indices("the outputs", outputs),
            ALL,
            example="1",
        )
        size = len(followed)
        draft.reference = {} if size == outputs else {"outputs": draft.plant["C"][followed]}
        changes = self.questions.choose(
            "the changes",
            "Do the set-points change while the loop runs?",
            ("never", "steps", "file"),
            "never",
            why="steps: jumps at random times. file: a table of times and set-points, separated by commas.",
        )
        if changes == "file":
            text = "File with rows of a time and the set-points from then on"
            read = timetable("the file", size, self.folder)
            draft.reference["file"] = ask("the file", text, read, example="levels.csv")
            return
        read, per = numbers("the set-points", size, "output"), "second" if draft.continuous else "step"
        draft.reference["value"] = ask("the set-points", "Set-point of each of these outputs", read, "0", example="2.5")
        if changes == "steps":
            draft.reference["steps"] = {
                "rate": ask("their rate", f"Mean number of steps per {per}", a_number("their rate", 0.0), "0.01"),
                "covariance": ask(
                    "their size",
                    "Typical size of a step, in the unit of the output",
                    deviations("their size", size, "output"),
                    "1",
                    example="0.5",
                ),
            }

    def _ask_kept_set_points(self) -> None:
        """Ask for the set-points of a controller to keep, which are constant."""
        kept: dict[str, Any] = self.draft.controller
        if "pid" not in kept:
            read = numbers("the set-points", self.draft.counts[1], "output")
            kept["setpoint"] = self.questions.ask(
                "the set-points", "Set-point of each output", read, "0", example="2.5"
            )
            return
        for one in cast("list[dict[str, Any]]", kept["pid"] if isinstance(kept["pid"], list) else [kept["pid"]]):
            what = f"the set-point of output {one.get('output', 1)}"
            value = self.questions.ask(what, f"Constant value of {what}", a_number(what), "0", example="2.5")
            one |= {"setpoint": value} if value else {}

    def _ask_disturbances(self) -> None:
        """Ask for disturbances; those of a controller to keep are slow, and act at the inputs."""
        ask, draft = self.questions.ask, self.draft
        if draft.controller:
            size = "Slow load at each input: its standard deviation, in the unit of the input"
            draft.controller["disturbance"] = {
                "deviation": ask("the load", size, a_number("the load", 0.0), "0.1"),
                "time_constant": ask(
                    "its time constant", "Its time constant, in seconds", a_number("its time constant", 0.0), "100"
                ),
            }
            return
        self._expect_noise("disturbances")
        while True:
            draft.disturbance.append(self._disturbance(f"disturbance {len(draft.disturbance) + 1}"))
            more = self.questions.choose("the answer", "Another disturbance?", ("yes", "no"), "no")
            if more == "no":
                return

    def _disturbance(self, name: str) -> dict[str, Any]:
        """Return the table of a disturbance."""
        ask, per = self.questions.ask, "second" if self.draft.continuous else "step"
        shape = self.questions.choose(
            f"the shape of {name}",
            f"Shape of {name}",
            ("constant", "ramp", "sinusoid"),
            "constant",
            why="Its shape is known and its size is not: it is estimated, and the input compensates it.",
        )
        states, what = len(self.draft.plant["A"]), f"the effect of {name}"
        found: dict[str, Any] = {
            "kind": shape,
            "enters": ask(
                what,
                f"Where it acts: input and its number, or its effect on each state per {per}",
                self._effect(what),
                "input 1",
                example=" ".join(["0"] * (states - 1) + ["0.3"]),
            ),
        }
        if shape == "sinusoid":
            read = a_number(f"the frequency of {name}", 0.0)
            found["frequency"] = ask(f"the frequency of {name}", f"Frequency, in radians per {per}", read, "1")
        what = f"the change of {name}"
        change = ask(what, f"Standard deviation by which its size changes in a {per}", a_number(what, 0.0), "0.01")
        return {**found, "wander": float(f"{change**2:.12g}")}

    def _effect(self, name: str) -> Callable[[str], Any]:
        """Read how a disturbance enters: as inputs do, or by one number for each state."""
        B = self.draft.plant["B"]

        def read(text: str) -> Any:
            word, _, rest = text.lower().partition(" ")
            if word in ("input", "inputs"):
                return B[:, parse_indices(name, rest, B.shape[1])].sum(axis=1)
            return parse_numbers(name, text, len(B), "state")

        return read

    def _ask_limits(self) -> None:
        """Ask for the limits of inputs, and of outputs."""
        draft = self.draft
        inputs, outputs = draft.counts
        scale = (
            " Values are deviations from the point around which A and B hold. A range around another number than 0, "
            "such as 0 to 2 kW or 15 to 25 °C, has absolute values, and a question about that point follows."
        )
        applied = np.tile([-np.inf, np.inf], (inputs, 1))
        if draft.takes_input_limits():
            why = "One number limits both sides. An input beyond its limit is clipped, and then no guarantee holds."
            applied = self._ranges("input", inputs, "-5 5", why + scale)
        else:
            self.questions.say("no policy accepts limits of inputs with these parts; those of outputs follow")
        if np.isfinite(applied).any():
            draft.plant["input_limit"] = applied
        seen = self._ranges("output", outputs, "-1 1", "evaluate prints how often an output leaves its range." + scale)
        limited = np.isfinite(seen).any(axis=1)
        if limited.any():
            low, high = seen[limited].T
            draft.limits = {"outputs": draft.made_plant().C[limited], "low": low, "high": high}
        if any(not low < 0 < high for low, high in (*applied.tolist(), *seen.tolist())):
            self._ask_operating_point(applied, seen)

    def _ask_operating_point(self, applied: Array, seen: Array) -> None:
        """Ask for the point at which the plant rests, from which A and B count, if limits are absolute values."""
        ask, draft = self.questions.ask, self.draft
        C = draft.made_plant().C
        self.questions.say("a range is not around 0, so its values are absolute, and A and B hold around another point")
        guess = {"u": _middles(applied), "x": np.linalg.pinv(C) @ _middles(seen)}
        point = {
            key: ask(
                what,
                f"{what[4:].capitalize()} at the operating point, where the plant rests",
                numbers(what, len(guess[key]), "one"),
                " ".join(f"{value:.6g}" for value in guess[key]),
                why="A x + B u of the model counts from here: a heater of 0 to 2 kW at 1.2 kW has −1.2 to 0.8 kW left.",
            )
            for key, what in (("u", "the inputs"), ("x", "the states"))
        }
        draft.operating_point = point if any(value.any() for value in point.values()) else {}
        if draft.operating_point and not np.any(draft.reference.get("value", 1.0)):
            del draft.reference["value"]  # then it is that of the operating point

    def _ranges(self, signal: str, size: int, example: str, why: str) -> Any:
        """Return the least and the largest value of each signal, (size, 2)."""
        found: list[tuple[float, float]] = []
        for i in range(size):
            name, text = f"the limits of {signal} {i + 1}", f"Least and largest value of {signal} {i + 1}, or none"
            found.append(self.questions.ask(name, text, limits(name), NONE, example=example, why=why))
        return np.array(found)

    def _expect_noise(self, what: str) -> None:
        """Ask for the noise of measurements if they are exact, since what is estimated needs noisy outputs."""
        if "V" in self.draft.plant:
            return
        self.questions.say(f"{what} are estimated from measurements with noise")
        self.ask_noise()


def _middles(ranges: Array) -> Array:
    """Return the middle of each range, and 0 for a range without two ends."""
    return np.array([float(one.mean()) if np.isfinite(one).all() else 0.0 for one in ranges])
