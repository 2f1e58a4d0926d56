"""Policies, one family per file; each carries its guarantee."""

from taciturn.design.consistent import consistent
from taciturn.design.integral import integral
from taciturn.design.lossy_lqg import lossy_lqg
from taciturn.design.lqg import lqg
from taciturn.design.periodic import all_time, periodic
from taciturn.design.remote_lqg import remote_lqg

__all__ = ["all_time", "consistent", "integral", "lossy_lqg", "lqg", "periodic", "remote_lqg"]
