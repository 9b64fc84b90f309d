"""Solvers: fixed step, adaptive, automatic, and those of SciPy, heyoka, SUNDIALS, MuJoCo and Drake."""
