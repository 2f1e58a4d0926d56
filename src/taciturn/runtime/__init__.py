"""Nodes that run a policy against packets: pure state machines, the wire format, and what drives them over UDP."""
