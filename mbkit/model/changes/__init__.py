"""Changes of a description: edit, lock, join and mount, and numbers that become free. A frozen model stays as it is."""
