"""Work of numba's compiler that has no effect on kernels, left out: they are compiled in half the time, to the same code.

Three quarters of the time to compile are Python's, and LLVM's a quarter. A release of numba that is newer than those this was
tried with, or with other parts inside, compiles as it is.
"""

from __future__ import annotations

import contextlib
from importlib import import_module
from typing import Any

# Of numba: tried with each from 0.61 on.
NEWEST_RELEASE = (0, 68)


def hasten() -> None:
    """Leave out work of numba's compiler that has no effect on kernels, in this process from now on.

    Does nothing for another release of numba than those tested.
    """
    if not fits_release():
        return
    for leave_out in (compare_set_flags, remember_signatures, emit_entry_points, find_lifetimes_late):
        with contextlib.suppress(AttributeError, ImportError):
            leave_out()


def fits_release() -> bool:
    """Whether the installed release of numba is one that the shortcuts were tested with."""
    release: tuple[int, int] = import_module("numba").version_info.short
    return release <= NEWEST_RELEASE


def _numba(module: str) -> Any:
    """Import a module of numba."""
    return import_module(f"numba.{module}")


def compare_set_flags() -> None:
    """Speed up numba: flags with equal explicit values compare equal without a comparison of all defaults."""
    flags = _numba("core.targetconfig").TargetConfig
    compare = flags.__eq__

    def alike(some: Any, other: Any) -> Any:
        return (type(some) is type(other) and some._values == other._values) or compare(some, other)

    flags.__eq__ = alike
    flags.__hash__ = lambda some: hash(type(some))  # numba hashes the names of the flags, which are a class's


def remember_signatures() -> None:
    """Speed up numba: cache the resolution of a call for its argument types, instead of resolving it at each use."""
    function, stack = _numba("core.types.functions").BaseFunction, _numba("core.targetconfig").ConfigStack
    resolve, flags = function.get_call_type, stack.top_or_none

    def call_type(function_type: Any, context: Any, args: Any, kws: Any) -> Any:
        if kws or not all(a.is_precise() for a in args):
            return resolve(function_type, context, args, kws)
        known = function_type.__dict__.setdefault("_lslam_signatures", {})
        key = context, tuple(args), flags()
        if key not in known:
            known[key] = resolve(function_type, context, args, kws)
        return known[key]

    function.get_call_type = call_type


def emit_entry_points() -> None:
    """Speed up numba: emit machine code only for functions that Python calls; others remain LLVM modules and are linked."""
    context, make_function = _numba("core.cpu").CPUContext, _numba("_dynfunc").make_function
    make = context.get_executable

    def make_entry(target: Any, library: Any, fndesc: Any, env: Any) -> Any:
        # Constants lie in the environment, whose address is that of machine code.
        if library._finalized or env.consts or _defines(library._final_module, fndesc.llvm_cpython_wrapper_name):
            return make(target, library, fndesc, env)
        library._finalize_final_module = lambda: setattr(library, "_finalized", True)
        library.finalize()
        return make_function(fndesc.lookup_module(), fndesc.qualname.split(".")[-1], "", 0, env, (library,))

    context.get_executable = make_entry


def _defines(module: Any, name: str) -> bool:
    """Whether an LLVM module has the body of a function, not only its declaration."""
    try:
        return not module.get_function(name).is_declaration
    except NameError:
        return False


def find_lifetimes_late() -> None:
    """Speed up numba: compute the lifetimes of variables only in the last pass, which needs them."""
    processor, lifetimes = _numba("core.postproc").PostProcessor, _numba("core.postproc").VariableLifetime
    process, in_order = processor.run, _numba("core.transforms").canonicalize_cfg

    def run(processing: Any, emit_dels: bool = False, extend_lifetimes: bool = False) -> None:
        function = processing.func_ir
        if emit_dels or function.is_generator:
            process(processing, emit_dels, extend_lifetimes)
            return
        function.blocks = in_order(function.blocks)
        function.variable_lifetime, function.generator_info = lifetimes(function.blocks), None

    processor.run = run
