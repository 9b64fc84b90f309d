"""Elements given by functions, as CasADi expressions."""
