"""Functions of dynamics on any engine: control in the space of a task, and variants of one model."""
