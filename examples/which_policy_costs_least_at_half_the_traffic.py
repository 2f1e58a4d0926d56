"""Which policy costs least for an inverted pendulum at half of its traffic, and what is its guarantee?

The pendulum falls within a fifth of a second, so the input that the actuator applies between sends matters most.
"""

import taciturn

pendulum = taciturn.load("inverted-pendulum")
rate = 0.5 / pendulum.design().tick  # sends per second
other = {"theta": None}
policies = {
    "periodic": pendulum.changed({**other, "kind": "periodic", "every": 2}),
    "periodic, predicting": pendulum.changed({**other, "kind": "periodic", "every": 2, "actuation": "model"}),
    "rollout": pendulum.changed({**other, "kind": "rollout", "horizon": 4, "every": 2}),
    "thesis, chapter 2": pendulum,
    "chapter 2, predicting": pendulum.changed({"actuation": "model"}),
    "threshold, predicting": pendulum.changed({**other, "kind": "absolute", "threshold": 1.0, "actuation": "model"}),
    "stochastic, predicting": pendulum.changed({**other, "kind": "stochastic", "actuation": "model"}),
}
found = taciturn.compare(policies, rate, standard_error=3e-4)
assert found.cost_all_time is not None
print(f"{rate:.0f} sends per second; sending every sample costs {found.cost_all_time:.4f}")
for one in found.ranking:
    more = 100 * (one.cost.value / found.cost_all_time - 1)
    bound = "none" if one.cost_bound is None else f"at most {100 * (one.cost_bound / found.cost_all_time - 1):.1f} %"
    print(f"{one.name:23s} {more:6.2f} % more ({one.parameter}); guarantee: {bound}")
assert [found.ranking[0].name, found.ranking[-1].name] == ["threshold, predicting", "periodic"]
