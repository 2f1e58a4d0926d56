"""How many carts share a radio of ten packets per step, if each may cost a fifth more than with one send per step?"""

import taciturn

RADIO, MORE = 10, 1.2
cart = taciturn.load("wiener-double-integrator")


def cost_of(loops: int, scheduler: str) -> float:
    """Return the cost of a cart relative to a send at every step."""
    found = taciturn.share_channel(
        {"cart": cart}, copies=loops, capacity=RADIO, scheduler=scheduler, steps=1000, confidence=0
    )
    above, periodic = found.cost.value / found.cost_all_time, found.cost_periodic / found.cost_all_time
    print(f"{loops:4} carts, {scheduler:11}: {above:.3f} (best periodic control at this load: {periodic:.3f})")
    return above


def most(scheduler: str) -> int:
    """Return the number of carts whose cost is within the limit, to five carts."""
    fits, too_many = RADIO, 30 * RADIO
    while too_many - fits > 5:
        loops = (fits + too_many) // 2
        fits, too_many = (loops, too_many) if cost_of(loops, scheduler) <= MORE else (fits, loops)
    return fits


in_turn, price = most("round-robin"), most("price")
print(f"{in_turn} carts with round-robin, {price} with price: {price / in_turn:.2f} times as many")
found = taciturn.share_channel({"cart": cart}, copies=price, capacity=RADIO, steps=1000)
assert found.lower_bound is not None
print(f"total cost {found.cost}; lower bound for every scheduler {found.lower_bound.cost:.1f}")
assert found.lower_bound.cost < found.cost.value
assert price > 2 * in_turn
