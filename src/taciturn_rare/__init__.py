"""Probabilities of rare violations, that is, how often the state of a loop leaves its limits.

``violations`` estimates the probabilities of a loop, and ``splitting`` simulates its paths with copies of those that
come near a limit.
"""
