"""Exact methods for errors that a send resets: quadrature of renewal equations, event times without a grid."""
