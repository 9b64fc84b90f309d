"""Step formulas of the integration methods as stages of compiled code."""
