"""Elements given by functions: forces of (t, q, v), bushings, and motion laws, as plain data."""
