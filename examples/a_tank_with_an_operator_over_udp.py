"""Does a tank follow its operator over UDP, although samples are missing and somebody draws water?

Processes run 20 times as fast as the tank. The operator types 9, which is beyond the range. Some samples are missing.
"""

import json
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
from matplotlib import rcParams
from matplotlib.figure import Figure

import taciturn

STEP, FAST = 0.1, 20  # seconds of the tank in a step; how much faster it runs here
STATED = ("reference.range=[[0, 4]]", "reference.ramp=[0.05]", "links.sensor.missing=0.1")
RUN = ["pid-tank", *(word for one in STATED for word in ("--set", one)), "--real-time", "--tick", str(STEP / FAST)]


def begin(*words: str) -> tuple[subprocess.Popen, str]:
    """Start a command of taciturn; return its process and the address on which it listens."""
    pipes = {"text": True, **dict.fromkeys(("stdin", "stdout", "stderr"), subprocess.PIPE)}
    found = subprocess.Popen([sys.executable, "-m", "taciturn", *words], **pipes)
    return found, "" if words[0] == "setpoint" else found.stderr.readline().split()[-1]


def steps(name: str) -> list[dict]:
    """Return the steps in a log so far."""
    return [json.loads(line) for line in Path(name).read_text(encoding="utf-8").splitlines()[:-1]]


plant = f"127.0.0.1:{49000 + time.time_ns() % 1000}"
actuator, there = begin("node", "actuator", *RUN, "--plant", plant)
controller, pid = begin("node", "controller", *RUN, "--peer", there, "--plant", plant, "--log", "pid.jsonl")
to = ("--bind", plant, "--peer", f"plant={pid}", "--peer", f"setpoint={pid}", "--log", "tank.jsonl")
tank, _ = begin("plant", *RUN, *to, "--load=-0.2@30", "--steps", "1200")
operator, _ = begin("setpoint", pid)
for at, value in ((50, 2), (70, 9), (95, 1)):  # seconds, set-point
    while len(steps("tank.jsonl")) < at / STEP:
        time.sleep(0.02)
    print(value, file=operator.stdin, flush=True)
print(tank.wait(), operator.communicate()[0])
_ = actuator.terminate(), controller.terminate()
level = np.array([row["x"][0] for row in steps("tank.jsonl")])
keys = ("timestamp", "sent_actuator", "y", "set_points_in_effect", "set_points")
told, sent, known, *points = (np.array([row[key] for row in steps("pid.jsonl")[: len(level)]]) for key in keys)
rcParams.update(taciturn.style() | {"figure.constrained_layout.use": True})
upper, lower = (figure := Figure(figsize=(7, 4))).subplots(2, 1, sharex=True, height_ratios=(4, 1))
upper.plot(STEP * np.arange(len(level)), level, label="level")
upper.step(told, points[0], "k--", label="set-point in effect")
upper.step(told, points[1], "k:", label="set-point as typed")
upper.axvline(30, color="C1", label="start of the load")
upper.set(title=f"The tank follows its operator, and sends in {100 * sent.mean():.0f} % of the steps", ylabel="level")
upper.legend()
lower.eventplot(told[sent > 0], lineoffsets=0, linelengths=0.7, colors="C0", linewidths=0.5)
lower.eventplot(told[np.equal(known[:, 0], None)], lineoffsets=1, linelengths=0.7, colors="C1", linewidths=0.5)
lower.set(yticks=[0, 1], yticklabels=["packets", "missing samples"], xlabel="time (s)")
figure.savefig("a_tank_with_an_operator_over_udp.svg")
assert max(abs(level[900:950].mean() - 4.0), abs(level[-50:].mean() - 1.0)) < 0.3
