"""Parts of kernels: functions that only kernels call.

numba treats every function as one that Python may call: it wraps it, optimises it together with all
that it calls, makes machine code of it and keeps that in files. Of functions that only kernels call
none of this is used, and it was most of the time that a first correction took. A part stops before:
each kernel links the parts that it needs, once, and is optimised and made machine code as a whole.

This goes by the inside of numba, and only where it is of a version that was tried; parts are
compiled as kernels are elsewhere.
"""

from __future__ import annotations

import gc
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cached_property
from typing import Any, TypeAlias

import numba
from llvmlite.binding import Linkage
from numba import njit
from numba.core import config, event
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import Compiler, CompileResult
from numba.core.registry import CPUDispatcher

from pcfix.ahead import compiles, wait_for
from pcfix.kept import Kept, folder_of_numba

Decorator: TypeAlias = Callable[[Any], Any]

TRIED = ("0.61", "0.62", "0.63", "0.64", "0.65", "0.66", "0.67", "0.68")
"""Versions of numba."""

_are_linked = numba.__version__.rpartition(".")[0] in TRIED and not config.DISABLE_JIT
if not (_are_linked or config.DISABLE_JIT):
    config.CACHE_DIR = str(folder_of_numba() or config.CACHE_DIR)


class _Listener(event.Listener):
    def on_start(self, event: Any) -> None:
        """Be told that something is compiled which is not kept."""
        compiles()

    def on_end(self, event: Any) -> None:
        """Be told that it is done."""


@contextmanager
def _no_collection() -> Iterator[None]:
    """Collect no garbage for a while: compiling makes little, and looking for it takes a sixth."""
    was_on = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_on:
            gc.enable()


event.register("numba:compile", _Listener())


def kernel(**options: Any) -> Decorator:
    """Return a decorator for functions that Python calls, with options of numba's ``njit``."""
    if not _are_linked:
        return njit(cache=True, **options)

    def compiled(function: Any) -> _Kernel:
        found = _Kernel(
            function, targetoptions={"nopython": True, **options}, pipeline_class=_KernelCompiler
        )
        found.enable_caching()
        return found

    return compiled


def part(**options: Any) -> Decorator:
    """Return a decorator for functions that only kernels call."""
    if not _are_linked:
        return njit(cache=True, **options)
    return lambda function: _Part(
        function, targetoptions={"nopython": True, **options}, pipeline_class=_PartCompiler
    )


class _PartLibrary(JITCodeLibrary):
    """The code of a part, which is not made machine code by itself."""

    def finalize(self) -> None:
        """Let those that link it leave it out once it is inlined everywhere."""
        for function in self._final_module.functions:
            if function.linkage == Linkage.external and not function.is_declaration:
                function.linkage = Linkage.linkonce_odr
        self._finalized = True

    def _get_module_for_linking(self) -> Any:
        """Return it with all that it calls, for functions that are no kernels of ours."""
        whole = self._final_module.clone()
        _link(self, whole)
        return whole


class _KernelLibrary(JITCodeLibrary):
    """The code of a kernel, into which go all parts that it needs."""

    def finalize(self) -> None:
        """Link each part once, and make machine code."""
        _link(self, self._final_module)
        self._linking_libraries: list[Any] = []
        super().finalize()


def _link(into: Any, module: Any) -> None:
    """Link what a library needs, callers first, as LLVM leaves out what nobody calls so far."""
    seen: set[Any] = set()
    order: list[Any] = []

    def visit(library: Any) -> None:
        if library not in seen:
            seen.add(library)
            if isinstance(library, _PartLibrary):
                for inner in library._linking_libraries:
                    visit(inner)
            order.append(library)

    for library in into._linking_libraries:
        visit(library)
    for library in reversed(order):
        is_part = isinstance(library, _PartLibrary)
        one = library._final_module if is_part else library._get_module_for_linking()
        module.link_in(one, preserve=True)
        if reloaded := getattr(library, "_reload_init", None):  # numba from 0.62 on
            into._reload_init.update(reloaded)


class _KernelCompiler(Compiler):
    _library = _KernelLibrary

    def define_pipelines(self) -> list[Any]:
        """Return the usual passes, on a library of our own."""
        state = self.state
        state.library = self._library(state.targetctx.codegen(), state.func_id.func_qualname)
        state.library.enable_object_caching()
        state.flags.no_cfunc_wrapper = True
        return list(super().define_pipelines())


class _PartCompiler(_KernelCompiler):
    _library = _PartLibrary

    def define_pipelines(self) -> list[Any]:
        """Return the usual passes but for the last ones: no wrapper, no machine code."""
        self.state.flags.no_cpython_wrapper = True
        self.state.flags.no_compile = True
        return super().define_pipelines()


class _Kernel(CPUDispatcher):
    def enable_caching(self) -> None:
        """Keep it as `pcfix.kept` says."""
        self._cache = Kept(self.py_func)

    def compile(self, signature: Any) -> Any:
        """Compile a kernel or load it, unless another process is compiling it."""
        wait_for(f"{self.py_func.__module__}.{self.py_func.__qualname__}")
        with _no_collection(), self._cache.alone():
            return super().compile(signature)


class _Part(CPUDispatcher):
    """A part. Called from Python, as tests do, it is compiled once more, for that call alone."""

    def add_overload(self, compiled: CompileResult) -> None:
        """Let kernels find it."""
        name = compiled.fndesc
        self.targetctx.insert_user_function(name, compiled.fndesc, [compiled.library])
        self.overloads[tuple(compiled.signature.args)] = compiled._replace(entry_point=name)

    @cached_property
    def _alone(self) -> Any:
        options = {name: value for name, value in self.targetoptions.items() if name != "nopython"}
        return njit(**options)(self.py_func)

    def _compile_for_args(self, *args: Any, **keywords: Any) -> Any:
        return self._alone._compile_for_args(*args, **keywords)
