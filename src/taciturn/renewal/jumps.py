"""Rate and cost of a chain with Poisson jumps."""

from __future__ import annotations

from taciturn.renewal.chain import Chain, NoQuadratureError, Renewal


def solve_jumps(chain: Chain, accuracy: float = 1e-7) -> Renewal:
    """Refuse."""
    raise NoQuadratureError("chains with jumps have no quadrature; simulate instead")
