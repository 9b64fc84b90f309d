"""Constraints: manifold, multipliers, redundancy, independent coordinates."""
