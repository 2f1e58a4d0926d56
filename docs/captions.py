"""Captions of the gallery: of each figure of the manual, by its page and section, in the order of the section."""

from __future__ import annotations

CAPTIONS: dict[str, tuple[str, ...]] = {
    "architecture#layers": ("The parts of the library, and which imports which.",),
    "certificates#certificates": ("Proved bounds on the decay, the gain and the cost of a loop.",),
    "channels#many-loops-on-one-channel": ("Loops that share the slots of a channel, against a lower bound.",),
    "choose-a-policy#a-rate-and-a-cost-together": ("Three policies at the same rate.",),
    "choose-a-policy#tune-to-a-budget": ("The search for the θ that meets a rate.",),
    "command-line#contents-of-a-problem-file": ("Nodes and links of a policy over acknowledged links.",),
    "comparison#comparison-with-other-policies-and-tools": ("Policies of the literature at equal rates.",),
    "consistency#a-threshold-that-loses-to-periodic-control": (
        "A threshold on the norm of the error costs more than periodic control at some rates.",
    ),
    "consistency#exactly-without-simulation": ("Intervals between sends: computed and simulated.",),
    "constraints#a-tank-and-a-set-point": ("A pump at its limit, with and without anti-windup.",),
    "explore#explore-a-problem": ("Cost, response and packets of a problem in the browser.",),
    "explore#the-record-of-a-run": ("The record of a run over a network with faults.",),
    "first-hour#plot-one-path": ("A crane with the same noise: events, and periodic control.",),
    "first-hour#trade-off-between-packets-and-cost": ("Cost of a crane against the packets to its drive.",),
    "import-a-model#from-python-control": ("Cost against packets of a servo from python-control.",),
    "keep-your-pid#keep-your-pid": ("Two tanks with two PI controllers: cost against traffic of all four links.",),
    "keep-your-pid#one-link": ("A tank with a PID controller: cost against packets.",),
    "limits#against-other-computations": ("Errors of Riccati solutions against 1,024 bits.",),
    "lossy-links#tracking": ("A robot follows a circle over a link that drops packets.",),
    "network#in-one-command": ("A run of nodes over UDP; a relay drops packets.",),
    "nonlinear#where-the-guarantee-of-the-linearisation-still-holds": (
        "Noise and θ for which two nonlinear plants keep the bound of their linearisation.",
    ),
    "notebooks/beside-python-control#a-step-response": ("A step response with every sample, and with events.",),
    "notebooks/fewer-packets-for-a-pid#your-pid-with-fewer-packets": (
        "A PID controller: cost against packets.",
        "A step of the set-point with a limited valve.",
    ),
    "notebooks/over-a-lossy-network#the-nodes-over-udp": ("Eight runs over UDP with the same dropped packets.",),
    "notebooks/over-a-lossy-network#with-and-without-acknowledgement": (
        "Cost with and without acknowledgements against the loss probability.",
    ),
    "notebooks/your-first-policy#a-policy": ("Position, force, packets and trigger of one run.",),
    "notebooks/your-first-policy#a-trade-off": ("Cost against packets, with held and predicted inputs.",),
    "notebooks/your-first-policy#the-choice": ("The fewest packets within an allowed cost.",),
    "own-policy#evaluate-tune-and-compare-it": (
        "One run of a rule of your own.",
        "This rule, excess and periodic control at the same rate.",
    ),
    "performance#the-engine": ("Simulated steps per second on one thread.",),
    "remote-sensing#a-finite-horizon-run": ("The steps in which a camera is queried on the way to the origin.",),
    "remote-sensing#the-rule": ("Nodes and links: measurements on request, and inputs when needed.",),
    "remote-sensing#the-schedule-as-an-object": ("A periodic schedule of sensor queries.",),
    "scheduling#lower-bound-over-all-schedules": ("Cost against rate, and a bound below all schedules.",),
    "set-points#four-tanks-with-a-leaking-valve": ("Four tanks follow set-points while a valve leaks.",),
    "several-nodes#against-periodic-control": ("Two sensors and two pumps at the same traffic: three rules.",),
    "several-nodes#the-policy": ("Nodes and links of four tanks.",),
    "sweeps#as-labelled-arrays": ("Cost and queries for a grid of two parameters.",),
    "twins#live-page": ("The live page of the omni-directional robot.",),
    "twins#the-omni-directional-robot": ("A round of the omni-directional robot, with its sends.",),
    "twins#the-rover": ("A run of the rover, with its inputs and requested pictures.",),
}
