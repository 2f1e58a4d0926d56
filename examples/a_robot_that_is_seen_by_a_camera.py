"""How much does a robot lose that is looked at seldom? The rover of the thesis, as a twin: 18 s, two missions.

Rigid bodies, a camera that is rendered when it is asked, image processing, UDP between processes. The camera is
calibrated and the model is identified first, both in the twin. Then the link to the camera dies for two seconds.
Needs the extra `twin`, and a graphics library: apt install libegl1 libgl1-mesa-dri.
"""

from taciturn.twin.faults import parse_fault
from taciturn.twin.prepared import prepare
from taciturn.twin.run import run_twin
from taciturn.twin.trial import Setup

rover = prepare("rover")
B, error = rover.model.B[0, 0], rover.model.B_standard_error[0, 0]
print(f"identified: {B / 0.3:.5f} ± {error / 0.3:.5f} m/s per percent; data sheet {rover.robot.rate[0][0]}")

run = run_twin(rover, Setup(runs=2, seed=1))
print(f"asked {run.rates['sensor'].value:.0%} of the steps, sent {run.rates['actuator'].value:.0%}")
print(f"cost {run.cost}, all-time {run.always.totals.mean():.1f}, guaranteed at most {run.cost_bound:.1f}")

blind = run_twin(rover, Setup(runs=2, seed=1, faults=(parse_fault("camera@3+2"),)), compare=False)
print(f"two seconds without a camera: cost {blind.cost}, {blind.trial.datagrams['questions']['unanswered']} unanswered")

assert run.trial.datagrams["unaccounted"] == 0
assert blind.trial.datagrams["questions"]["unanswered"] > 0
assert run.cost.value < run.cost_bound
