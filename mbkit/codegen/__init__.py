"""Machine code, C source, extended precision and Taylor series from CasADi graphs."""
