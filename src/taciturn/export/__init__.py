"""Turns the nodes of a policy into C99 sources and co-simulation units."""
