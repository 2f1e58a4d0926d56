"""A radio carries ten packets per tick. How many carts may it steer, if each may cost a fifth more than it must?"""

import taciturn

RADIO, MORE = 10, 1.2
cart = taciturn.load("wiener-double-integrator")


def cost_of(loops: int, scheduler: str) -> float:
    """Return what a cart costs, in units of what it costs if it can always send."""
    found = taciturn.share_channel(
        {"cart": cart}, copies=loops, capacity=RADIO, scheduler=scheduler, ticks=1000, confidence=0
    )
    above, clock = found.cost.value / found.cost_all_time, found.cost_periodic / found.cost_all_time
    print(f"{loops:4} carts, {scheduler:11}: {above:.3f} (the best clock of this load: {clock:.3f})")
    return above


def most(scheduler: str) -> int:
    """Return how many carts cost no more than they may."""
    fits, too_many = RADIO, 30 * RADIO
    while too_many - fits > 5:
        loops = (fits + too_many) // 2
        fits, too_many = (loops, too_many) if cost_of(loops, scheduler) <= MORE else (fits, loops)
    return fits


clock, price = most("round-robin"), most("price")
print(f"in turns {clock} carts, where it pays {price}: {price / clock:.2f} times as many")
found = taciturn.share_channel({"cart": cart}, copies=price, capacity=RADIO, ticks=1000)
assert found.lower_bound is not None
print(f"{found.cost} together; no scheduler costs less than {found.lower_bound.cost:.1f}")
assert found.lower_bound.cost < found.cost.value
assert price > 2 * clock
