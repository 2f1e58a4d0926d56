"""How many years of battery life does event-triggered control add to a room's temperature sensor?

The sensor reads the temperature every five minutes, filters it, and sends its estimate over LoRa to the heater, which
predicts from it. Periodic control would send every ten minutes. How long do two AA cells last at the same comfort?
"""

import numpy as np
from matplotlib import rcParams
from matplotlib.figure import Figure

import taciturn
from taciturn.lqg.discrete import discretise

# room air, walls, heater, sensor (kWh/K), resistances between them (K/kW): TiTeThTsAe of bacher2011, house of 120 m²
Ci, Ce, Ch, Cs = 0.0928, 3.32, 0.889, 0.0549
Rie, Rea, Rih, Ris = 0.897, 4.38, 0.146, 1.89
GAIN, HOURS, CHECKS = 0.5, 0.5, 12  # heat of sun and people (kW), its time constant (h): assumed; checks per hour

house = taciturn.ContinuousPlant(  # states: deviations of air, walls, heater, sensor; gain; unit of time: hour
    A=[[-(1 / Rie + 1 / Rih + 1 / Ris) / Ci, 1 / (Rie * Ci), 1 / (Rih * Ci), 1 / (Ris * Ci), 1 / Ci],
       [1 / (Rie * Ce), -(1 / Rie + 1 / Rea) / Ce, 0, 0, 0], [1 / (Rih * Ch), 0, -1 / (Rih * Ch), 0, 0],
       [1 / (Ris * Cs), 0, 0, -1 / (Ris * Cs), 0], [0, 0, 0, 0, -1 / HOURS]],
    B=[[0], [0], [1 / Ch], [0], [0]], W=np.diag([0, 0, 0, 0, 2 * GAIN**2 / HOURS]), C=[[0, 0, 0, 1, 0]], V=[[0.1**2]],
)  # fmt: skip
model = discretise(house, taciturn.Cost(Q=np.diag([1.0, 0, 0, 0, 0]), R=[[0.01]]), 1 / CHECKS)  # K², and a little kW²
comfort = taciturn.Cost(model.Q, model.R, model.N)
room = taciturn.Problem(model.plant, comfort, taciturn.Network(), "excess", {"delta": 1e-3, "actuation": "model"})

# data sheets: Semtech SX1276, LoRa at spreading factor 12 and 125 kHz: five numbers of 16 bits are 30.25 symbols of
# 2^12 chips at 29 mA (13 dBm), 0.2 µA in sleep; ST STM32L072: 0.86 µA in sleep, 93 µA/MHz, 16 MHz for 10 ms per check;
# Energizer L91: 3 Ah, shelf life of 20 years
CELL, SHELF = 3.0 * 3600, 20.0  # A s, years
SEND, CHECK, SLEEP = 29e-3 * 30.25 * 2**12 / 125e3, 93e-6 * 16 * 0.01, (0.86 + 0.2) * 1e-6  # A s, A s, A


def years(rate: float) -> float:
    """Return the life of the cells in years, given the sends per check."""
    return min(CELL / (SLEEP + (CHECK + rate * SEND) * CHECKS / 3600) / (365.25 * 86400), SHELF)


base, every = room.design().cost_all_time, np.arange(1, 7)
clocks = [taciturn.design.periodic(model.plant, comfort, every=k, actuation="model") for k in every]
periodic = [policy.theory.closed_form.cost for policy in clocks]
found = taciturn.tune(room, cost=periodic[1], standard_error=1e-4 * base)  # the comfort of sends every ten minutes
rate = found.evaluation.rates["actuator"]
path = taciturn.simulate(taciturn.close(model.plant, found.problem.design(), room.network, comfort), steps=200_000)
marks = float(np.mean((np.diff(np.flatnonzero(path.sends["actuator"])) - 1) // 33)) * rate.value  # --watchdog 100
now, before = years(rate.value + marks), years(1 / 2)
error = now - years(rate.value + marks + rate.standard_error)
answer = f"Two AA cells last {now:.1f} years instead of {before:.1f}, at the same comfort"
print(f"{answer}: {rate.scaled(CHECKS)} messages and {CHECKS * marks:.0e} marks of a silent sensor per hour")
events = [taciturn.evaluate(room.changed({"delta": d}), steps=500_000) for d in (1e-5, 5e-5, 2e-4, 5e-4, 1e-3)]
rcParams.update(taciturn.style())
axes = (figure := Figure(figsize=(7, 4.2), layout="constrained")).subplots()
axes.plot([years(1 / k) for k in every], np.array(periodic) / base, "o-", label="periodic, every 5, 10, … 30 minutes")
lives = [years(each.rates["actuator"].value) for each in events]
axes.plot(lives, [each.cost.value / base for each in events], "o-", label="event-triggered")
axes.plot([before, now], [periodic[1] / base] * 2, "k:", label="same comfort")
axes.set(xlabel="life of two AA cells (years)", ylabel="cost relative to sending every 5 minutes", title=answer)
axes.legend(title=f"{now - before:.2f} ± {error:.2f} years gained")
figure.savefig("how_many_years_does_a_battery_gain.svg")
assert now - 4 * error > 1.5 * before
