"""Compiled parts of solvers; each is imported when it is needed, as numba takes time to load."""
