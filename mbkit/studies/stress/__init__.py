"""Where engines and methods break: sweeps of one number over decades, each run in a process of its own."""
