"""Runs with dry friction, phase by phase: between two changes of what slides and what rests the motion is smooth."""
