"""Equation (8) for few queries as loops, which Numba compiles where it is installed."""
