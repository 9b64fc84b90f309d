"""Exact normal form of trigonometric expressions."""
