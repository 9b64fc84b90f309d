"""Solvers: fixed step, adaptive, automatic, and those of SciPy, heyoka, MuJoCo and Drake."""
