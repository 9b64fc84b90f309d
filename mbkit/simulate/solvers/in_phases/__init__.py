"""Runs with forces that jump, phase by phase: between changes of what slides and what rests the motion is smooth."""
