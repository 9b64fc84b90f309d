"""Systems defined by their energies: symbols, equations of motion, models."""
