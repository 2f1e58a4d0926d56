"""Probabilities of rare violations: how often a loop exceeds limits of its states.

``violations`` estimates the probabilities of a loop, and ``splitting`` simulates its paths with copies of those that
come near a limit.
"""
