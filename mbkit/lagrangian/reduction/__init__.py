"""Conserved quantities, Routh's and Hamilton's equations, quasi-velocities."""
