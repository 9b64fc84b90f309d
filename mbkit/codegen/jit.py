"""Machine code for this processor, or for a level of x86-64 that others share, by LLVM (llvmlite): object files."""

from __future__ import annotations

import ctypes
import os
import threading
from collections.abc import Callable
from functools import cache
from typing import Any, Final, NamedTuple

import llvmlite
from llvmlite import binding as llvm

from mbkit._process import fork_safe
from mbkit.codegen import disk_cache as disk
from mbkit.codegen.batch_loop import MAX_ARRAYS, RUN, batch_code
from mbkit.codegen.program import Program
from mbkit.codegen.simd_kernel import vector_code
from mbkit.derivation.fingerprint import SOURCES
from mbkit.errors import InputError

_SIGNATURE: Final = ctypes.CFUNCTYPE(None, ctypes.c_void_p, ctypes.c_void_p, ctypes.c_int64, ctypes.c_int64)


class Host(NamedTuple):
    """A processor, as machine code depends on it; `width` counts doubles in a register, `fma` says whether it fuses."""

    triple: str
    cpu: str
    features: str
    width: int
    fma: bool
    llvm: str

    def lowered(self, program: Program) -> Program:
        """Return the program with the operations that this processor has."""
        return program.fused if self.fma else program


class Loaded:
    """A function in memory; its code lives as long as this object."""

    def __init__(self, engine: Any) -> None:
        self._engine = engine
        #: Called with the addresses of table and work space and a range of samples; other Python threads run meanwhile.
        self.run = _SIGNATURE(engine.get_function_address(RUN))


#: One thread compiles at a time: LLVM's own tables are shared by the process.
COMPILING: Final = fork_safe(threading.RLock())
_OF_LLVMLITE: Final = getattr(getattr(llvm.ffi.lib, "_lock", None), "_lock", None)
if _OF_LLVMLITE is not None:
    # Modules are also freed outside of COMPILING, under the lock of llvmlite itself.
    fork_safe(_OF_LLVMLITE)


#: Levels of x86-64 (System V ABI, AMD64 supplement, table 3.1): what a processor needs for each, and the doubles in
#: one of its registers.
LEVELS: Final[dict[str, tuple[frozenset[str], int]]] = {
    "x86-64": (frozenset(), 2),
    "x86-64-v2": (frozenset({"sse4.2", "popcnt"}), 2),
    "x86-64-v3": (frozenset({"avx2", "bmi2", "f16c", "fma"}), 4),
    "x86-64-v4": (frozenset({"avx512f", "avx512bw", "avx512cd", "avx512dq", "avx512vl"}), 8),
}


@cache
def host() -> Host:
    """Return what machine code depends on: this processor, or the level that ``MBKIT_CPU`` names.

    It is the same for the whole process: parts that are compiled once have registers of one width.

    Raises
    ------
    InputError
        ``MBKIT_CPU`` names no level, or one that this processor has not.
    """
    return host_of(os.environ.get("MBKIT_CPU", ""))


def host_of(level: str) -> Host:
    """Return the same of a level, or of this processor where it is empty."""
    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    flags, triple = llvm.get_host_cpu_features(), llvm.get_process_triple()
    version = f"llvmlite {llvmlite.__version__}, LLVM {'.'.join(map(str, llvm.llvm_version_info))}"
    if not level:
        width = 8 if flags.get("avx512f") else 4 if flags.get("avx") else 2
        fma = bool(flags.get("fma")) or not triple.startswith("x86_64")
        return Host(triple, llvm.get_host_cpu_name(), flags.flatten(), width, fma, version)
    have = [name for name, (needs, _) in LEVELS.items() if triple.startswith("x86_64") and all(map(flags.get, needs))]
    if level not in have:
        raise InputError(
            f"MBKIT_CPU: expected a level that this processor has, {', '.join(have) or 'of which there is none'}, got "
            f"{level!r}; unset it to compile for this processor"
        )
    needs, width = LEVELS[level]
    return Host(triple, level, "", width, "fma" in needs or level == "x86-64-v4", version)


def _target() -> Any:
    h = host()
    return llvm.Target.from_triple(h.triple).create_target_machine(cpu=h.cpu, features=h.features, opt=2, jit=True)


def object_code(text: str, *, optimize: bool = False) -> bytes:
    """Return the object file of LLVM's textual code.

    `optimize` runs LLVM's passes over the text first, for loops written with llvmlite's builder, compiled once in a
    process. A kernel gains nothing by them: it is one block whose common expressions CasADi has shared. Its compilation
    would take a quarter longer, and llvmlite 0.50 never frees a pass manager, nor the callbacks of a pass builder.
    """
    # LLVM keeps the constants and types of what it compiles as long as the context, of which a global one
    # would grow for ever.
    with COMPILING, llvm.create_context() as context, llvm.parse_assembly(text, context) as module:
        target = _target()
        if optimize:
            builder = llvm.create_pass_builder(target, llvm.create_pipeline_tuning_options(speed_level=1))
            builder.getModulePassManager().run(module, builder)
        return bytes(target.emit_object(module))


def program_object(program: Program) -> tuple[bytes, int]:
    """Return a program's object file, and how many doubles of work space its body needs."""
    if max(len(program.inputs), len(program.outputs)) > MAX_ARRAYS:
        raise ValueError(f"expected at most {MAX_ARRAYS} arguments and as many results")
    width = host().width
    text, vectors = vector_code(program, width)
    return object_code(text), vectors * width


def batch_object() -> bytes:
    """Return the object file of the loop over a batch, which every program shares."""
    return object_code(batch_code(host().width), optimize=True)


def load(*objects: bytes) -> Loaded:
    """Return the function of object files that belong together."""
    host()
    with COMPILING:
        # llvmlite's memory manager keeps all sections within reach of one another.
        engine = llvm.create_mcjit_compiler(llvm.parse_assembly(""), _target(), use_lmm=True)
        for code in objects:
            engine.add_object_file(llvm.ObjectFileRef.from_data(code))
        engine.finalize_object()
        return Loaded(engine)


def shared_object(name: str, make: Callable[[], bytes]) -> bytes:
    """Return an object file that depends on no model, from disk or compiled now."""
    key = disk.key_of(name, SOURCES, *map(str, host()))
    if (entry := disk.read(key)) is not None:
        return entry[1]
    code = make()
    disk.write(key, {}, code)
    return code
