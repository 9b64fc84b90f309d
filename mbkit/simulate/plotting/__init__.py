"""Figures of a trajectory: time series, stick figures, motion strips."""
