"""Error against run time: reference motions, curves, figures."""
