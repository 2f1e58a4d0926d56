"""Write an output of ``ping -D``, for a page that needs measured delays and has no network to measure."""

from __future__ import annotations

from pathlib import Path

import numpy as np

PACKETS, INTERVAL, LOSS = 2000, 0.02, 0.01  # packets, s between them, share that is lost
LEAST, MEAN = 4.0, 12.0  # ms of a round trip: the smallest, and the mean of the rest


def ping(path: Path) -> None:
    """Write random round trips, with the times of their ends, as ping does on Linux."""
    rng = np.random.default_rng(1)
    trips = LEAST + rng.gamma(2.0, MEAN / 2, PACKETS)
    came = rng.random(PACKETS) > LOSS
    lines = [
        f"[{1.7e9 + INTERVAL * k + trip / 1e3:.6f}] 64 bytes from 192.168.1.20: icmp_seq={k} ttl=64 time={trip:.2f} ms"
        for k, (trip, here) in enumerate(zip(trips, came, strict=True), 1)
        if here
    ]
    total = f"{PACKETS} packets transmitted, {len(lines)} received, {1 - len(lines) / PACKETS:.0%} packet loss"
    path.write_text(
        "\n".join(["PING 192.168.1.20 (192.168.1.20) 56(84) bytes of data.", *lines, total]), encoding="utf-8"
    )
