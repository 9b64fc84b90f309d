"""Diagnostics of a run: linearization, eigenvalues, stability of a step, checks."""
