"""How much does it cost to query a robot's camera rarely? The thesis's rover as a digital twin, in two runs of 18 s.

The twin simulates rigid bodies, a camera that renders a picture on request, image processing, and processes that
communicate over UDP. The camera is calibrated and the model identified first, both in the twin. In a second experiment
the link to the camera fails for two seconds. Requires the extra `twin` and a graphics library: apt install libegl1
libgl1-mesa-dri.
"""

from taciturn_twins.faults import parse_fault
from taciturn_twins.prepared import prepare
from taciturn_twins.run import run_twin
from taciturn_twins.trial import Setup

rover = prepare("rover")
B, error = rover.model.B[0, 0], rover.model.B_standard_error[0, 0]
print(f"identified: {B / 0.3:.5f} ± {error / 0.3:.5f} m/s per percent; data sheet {rover.robot.rate[0][0]}")

run = run_twin(rover, Setup(runs=2, seed=1))
print(f"queries in {run.rates['sensor'].value:.0%} of the steps, inputs sent in {run.rates['actuator'].value:.0%}")
print(f"cost {run.cost}, at every sample {run.always.totals.mean():.1f}, guaranteed at most {run.cost_bound:.1f}")

blind = run_twin(rover, Setup(runs=2, seed=1, faults=(parse_fault("camera@3+2"),)), compare=False)
unanswered = blind.trial.datagrams["questions"]["unanswered"]
print(f"camera link down for two seconds: cost {blind.cost}, {unanswered} unanswered queries")

assert run.trial.datagrams["unaccounted"] == 0
assert unanswered > 0
assert run.cost.value < run.cost_bound
