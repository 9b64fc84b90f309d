"""Machine code, C source, extended precision and Taylor series from CasADi graphs.

Start with `program`: it turns a CasADi function into a list of scalar operations, which all other modules read.
`simd_kernel` writes it in LLVM's language for several states at once, `batch_loop` the loop over a batch around it,
and `jit` lets LLVM make machine code, which `disk_cache` keeps. `compiled` is the function that comes out.
`step_loop` runs the parts of a step in one piece; `python_call` is the short way in for one state; `cuda` is a GPU.
`interpreter` runs the function without a compiler, `extended_precision` with 34 digits, `taylor` as a Taylor series;
`c_source` writes it as C.

In: a CasADi function and a name of all that it depends on. Out: a callable on NumPy arrays. No mechanics is here.
Callers: the engines through `backend`, which selects compiler, interpreter or GPU; the solvers; the oracle.
"""
