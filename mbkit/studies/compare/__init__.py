"""Comparison of engines: terms, rollouts, what was left out."""
