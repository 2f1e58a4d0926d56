"""An inverted pendulum may use half of its traffic: which policy balances it best, and what is proved of it?

The pendulum falls within a fifth of a second, so that what the actuator does in silence matters most.
"""

import taciturn

pendulum = taciturn.load("inverted-pendulum")
rate = 0.5 / pendulum.design().tick  # sends per second
other = {"theta": None}
policies = {
    "clock": pendulum.changed({**other, "kind": "periodic", "every": 2}),
    "clock, rearranged": pendulum.changed({**other, "kind": "rollout", "horizon": 4, "every": 2}),
    "ch. 2 of the thesis": pendulum,
    "ch. 2, predicting": pendulum.changed({"actuation": "model"}),
    "threshold, predicting": pendulum.changed({**other, "kind": "absolute", "threshold": 1.0, "actuation": "model"}),
    "drawn, predicting": pendulum.changed({**other, "kind": "stochastic", "actuation": "model"}),
}
found = taciturn.compare(policies, rate, standard_error=3e-4)
assert found.cost_all_time is not None
print(f"{rate:.0f} sends per second; sending always costs {found.cost_all_time:.4f}")
for one in found.ranking:
    more = 100 * (one.cost.value / found.cost_all_time - 1)
    bound = "nothing" if one.cost_bound is None else f"at most {100 * (one.cost_bound / found.cost_all_time - 1):.1f} %"
    print(f"{one.name:22s} {more:6.2f} % more ({one.parameter}); proved: {bound}")
assert [found.ranking[0].name, found.ranking[-1].name] == ["threshold, predicting", "clock"]
