"""Equilibria, force balance, small motions and virtual work."""
