"""Policies, one family per file; each carries its guarantee."""

from taciturn.design.lqg import lqg
from taciturn.design.periodic import all_time, periodic

__all__ = ["all_time", "lqg", "periodic"]
