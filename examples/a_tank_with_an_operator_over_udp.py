"""Does a tank follow its operator over UDP, although samples are missing and somebody draws water?

The built-in tank and its PID controller run as processes in real time, 20 times as fast as the tank. The operator types
three set-points, of which one is beyond the range. One sample in ten is missing, and a load acts from 30 s on.
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

STEP, FAST, STEPS = 0.1, 20, 1200  # seconds of the tank; how much faster it runs here; steps
ASKED = [(50.0, 2.0), (70.0, 9.0), (95.0, 1.0)]  # seconds, set-point
STATED = ("reference.range=[[0, 4]]", "reference.ramp=[0.05]", "links.sensor.missing=0.1")
RUN = ["pid-tank", *(word for one in STATED for word in ("--set", one)), "--real-time", "--tick", str(STEP / FAST)]


def begin(*words: str) -> tuple[subprocess.Popen, str]:
    """Start a command of taciturn; return its process and the address on which it listens."""
    pipes = dict.fromkeys(("stdin", "stdout", "stderr"), subprocess.PIPE)
    found = subprocess.Popen([sys.executable, "-m", "taciturn", *words], text=True, **pipes)
    return found, "" if words[0] == "setpoint" else found.stderr.readline().split()[-1]


def steps(name: str) -> list[dict]:
    """Return the steps in a log so far."""
    return [json.loads(line) for line in Path(name).read_text().splitlines()[:-1]]


plant = f"127.0.0.1:{49000 + time.time_ns() % 1000}"
actuator, there = begin("node", "actuator", *RUN, "--plant", plant)
controller, pid = begin("node", "controller", *RUN, "--peer", there, "--plant", plant, "--log", "pid.jsonl")
to = ("--bind", plant, "--peer", f"plant={pid}", "--peer", f"setpoint={pid}", "--log", "tank.jsonl")
tank, _ = begin("plant", *RUN, *to, "--load=-0.2@30", "--steps", str(STEPS))
operator, _ = begin("setpoint", pid)
print(operator.stdout.readline(), end="")
for at, value in ASKED:
    while len(steps("tank.jsonl")) < at / STEP:
        time.sleep(0.02)
    print(value, file=operator.stdin, flush=True)
tank.wait()
print(operator.communicate()[0])
for node in (actuator, controller):
    node.terminate()

rows, own = steps("tank.jsonl"), steps("pid.jsonl")
time_s, level = (np.array([row[key] for row in rows]) for key in ("timestamp", "x"))
given, effect = (np.array([row[key][0] for row in own]) for key in ("set_points", "set_points_in_effect"))
told, sent, known = (np.array([row[key] for row in own]) for key in ("timestamp", "sent_actuator", "y"))
rcParams.update(taciturn.style())
upper, lower = (figure := Figure(figsize=(7, 4), layout="constrained")).subplots(
    2, 1, sharex=True, height_ratios=(4, 1)
)
upper.plot(time_s, level[:, 0], label="level")
upper.step(told, effect, "k--", label="set-point in effect")
upper.set(title=f"The tank follows its operator with {100 * sent.mean():.0f} % of the packets", ylabel="level")
upper.legend(fontsize="small")
missing = np.equal(known[:, 0], None)
for place, (times, colour) in enumerate(((told[sent > 0], "C0"), (told[missing], "C3"))):
    lower.eventplot(times, lineoffsets=place, linelengths=0.7, colors=colour)
lower.set(yticks=[0, 1], yticklabels=["packets", "missing samples"], xlabel="time of the tank (s)")
figure.savefig("a_tank_with_an_operator_over_udp.svg")
assert abs(level[900:950, 0].mean() - 4.0) < 0.2, "the level is at the end of the range"
assert abs(level[-50:, 0].mean() - 1.0) < 0.2, "the level is at the last set-point"
