"""Mechanisms: forces of actuators, in joints and loops, motion by independent coordinates, rows from moving frames."""
