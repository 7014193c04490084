"""Compile numerical functions with numba, cached on disk and never stale."""

import gc
import hashlib
import os
import sys
import warnings
from collections.abc import Callable
from contextlib import suppress
from functools import cache, update_wrapper
from pathlib import Path
from typing import Any, TypeVar

import numba
from numba.core import event, types
from numba.core.registry import CPUDispatcher
from numba.core.types.functions import BaseFunction
from numba.np.ufunc.parallel import threading_layer

from trajectories.disk_cache import DiskCache, warn_of_no_cache

Function = TypeVar("Function", bound=Callable[..., Any])

HERE = Path(__file__).parent
NUMBERS = (types.Float, types.Integer, types.Boolean)
"""Numba's types of numbers that carry no literal value."""

_compiled_here: set[Callable[..., Any]] = set()


def compiled(function: Function) -> Function:
    """`numba.njit` with IEEE arithmetic, an on-disk cache, and division by zero giving inf.

    Where no cache folder is writable, warn once and compile anew in every process.
    """
    return _compile(function)


def compiled_in_place(function: Function) -> Function:
    """`compiled`, inlined into its callers by numba.

    For large functions with few callers: LLVM optimises each level of calls between large functions
    all over again, which takes seconds. Not for functions called from parallel loops.
    """
    return _compile(function, inline="always")


def compiled_internal(function: Function) -> Function:
    """`compiled` without wrappers, for functions called from compiled code: half the time.

    Unboxing a few arrays takes longer to compile than a short function that works on them. Python
    can call the function too, but compiles an entry point in each process: good enough for tests.
    """
    return _compile_internal(function)


def compiled_inline(function: Function) -> Function:
    """`compiled_internal`, always inlined by LLVM: for the body of a loop to be vectorised."""
    return _compile_internal(function, forceinline=True)


def compiled_parallel(function: Function) -> "Threaded":
    """`compiled`, with `numba.prange` loops run in threads, each calling one ordinary function.

    (A body that numba inlines into such a loop was seen to give wrong results.)
    """
    return Threaded(function)


class Threaded:
    """A compiled function whose loops run in threads, and in one after a fork that ends them.

    GNU's OpenMP ends a process that starts threads after a fork from one that had them. There the
    function runs in one thread, with the same results, and says so once.
    """

    def __init__(self, function: Callable[..., Any]) -> None:
        update_wrapper(self, function)
        self.parallel: Any = _compile(function, parallel=True, _nrt=True)
        self.alone: Any = _compile(function, _nrt=True)

    def __call__(self, *arguments: Any) -> Any:
        """Call the function with loops in threads, if this process can have them."""
        if _threads_lost:
            warn_of_lost_threads()
            return self.alone(*arguments)
        return self.parallel(*arguments)

    def entry_point(self, *arguments: Any) -> Callable[..., Any]:
        """Return the machine code for these types of arguments; see `entry_point`."""
        entry = entry_point(self.parallel, *arguments)
        return lambda *given: self(*given) if _threads_lost else entry(*given)


def compiled_with_lists(*folders: Path) -> Callable[[Function], Function]:
    """`compiled`, for functions that allocate lists or arrays, as other packages' models do.

    `folders` hold further sources that the function calls: a change there makes its cache stale.
    """
    return lambda function: _compile(function, *folders, _nrt=True)


def entry_point(function: Callable[..., Any], *arguments: Any) -> Callable[..., Any]:
    """Return the machine code of a compiled function for these types of arguments.

    A call of the function itself looks up the types of all arguments, which takes as long as to
    pass them: 0.2 us for a handful of arrays. A call of the returned function does not, so it must
    be given arguments of the very same types: an array of another layout would be misread.
    """
    if isinstance(function, Threaded):
        return function.entry_point(*arguments)
    if not isinstance(function, numba.core.dispatcher.Dispatcher):
        return function  # With NUMBA_DISABLE_JIT=1 it is plain Python.
    entry: Callable[..., Any] = function.compile(tuple(map(numba.typeof, arguments)))
    return entry


def _compile(function: Function, *sources: Path, **more: bool | str) -> Function:
    # Without numba's runtime there are no references to count, which saves a tenth of the time to
    # compile. No memory can be allocated then, but views of arrays work.
    options: dict[str, Any] = {"error_model": "numpy", "fastmath": False, "_nrt": False, **more}
    _compiled_here.add(function)
    dispatcher: Any = numba.njit(**options)(function)
    if isinstance(dispatcher, numba.core.dispatcher.Dispatcher):
        folders = _packages_for(Path(function.__code__.co_filename).parent)
        digest = source_digest(*dict.fromkeys((*folders, *sources)))
        try:
            # As `njit(cache=True)` does with the cache that is numba's own.
            dispatcher._cache = DiskCache(function, options, digest)  # type: ignore[attr-defined]  # noqa: SLF001
        except RuntimeError:
            warn_of_no_cache()
    return dispatcher  # type: ignore[no-any-return]


def _compile_internal(function: Function, **more: bool) -> Function:
    dispatcher: Any = _compile(function, no_cpython_wrapper=True, no_cfunc_wrapper=True, **more)
    if isinstance(dispatcher, CPUDispatcher):
        dispatcher.__class__ = _Internal
    return dispatcher  # type: ignore[no-any-return]


class _Internal(CPUDispatcher):
    """A compiled function without wrappers; the first call from Python compiles an entry point."""

    def __call__(self, *arguments: Any) -> Any:
        if not hasattr(self, "_entry"):
            internal = self
            self._entry = numba.njit(lambda *given: internal(*given))  # noqa: PLW0108
        return self._entry(*arguments)

    def get_call_template(self, args: Any, kws: Any) -> Any:
        # Otherwise numba compiles one version for each integer that callers write out.
        plain = {name: _without_literal(kind) for name, kind in kws.items()}
        return super().get_call_template([_without_literal(kind) for kind in args], plain)


def _without_literal(kind: Any) -> Any:
    """Return the type of a literal integer's value in place of the literal's own type."""
    return kind.literal_type if isinstance(kind, types.IntegerLiteral) else kind


@cache
def source_digest(*folders: Path) -> str:
    """Digest of all Python sources in some folders.

    numba notices a change in the file of a cached function, but not in the functions that it calls
    or in the constants that it imports: this digest closes the gap.
    """
    digest = hashlib.sha256()
    for folder in folders:
        for file in sorted(folder.rglob("*.py")):
            name = file.relative_to(folder.parent).as_posix()
            digest.update(name.encode() + b"\0" + file.read_bytes())
    return digest.hexdigest()


@cache
def _packages_for(folder: Path) -> list[Path]:
    """Folders of the packages whose sources a compiled function of some folder may use.

    These are this package, every loaded package that has `COMPILED_LIBRARY = True` (compiled
    functions and constants for the packages above it), and the function's own.
    """
    own = folder
    while (own.parent / "__init__.py").is_file():
        own = own.parent
    if own == HERE:
        return [HERE]
    packages = [module for name, module in sys.modules.items() if "." not in name]
    libraries = [one for one in packages if getattr(one, "__dict__", {}).get("COMPILED_LIBRARY")]
    return [HERE, *sorted(Path(str(one.__file__)).parent for one in libraries), own]


_threads_lost = False
"""True in a process forked from one that has run loops in OpenMP's threads."""


def _after_fork() -> None:
    global _threads_lost  # noqa: PLW0603
    with suppress(ValueError):  # No loop has run in threads.
        _threads_lost = _threads_lost or threading_layer() == "omp"  # type: ignore[no-untyped-call]


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_after_fork)


@cache
def warn_of_lost_threads() -> None:
    """Warn, once in a process, that threads are lost by a fork."""
    warnings.warn(
        "this process was forked from one that had run threads, which OpenMP does not allow here: "
        "continuing with threads=1 (the start methods 'spawn' and 'forkserver' keep threads)",
        RuntimeWarning,
        stacklevel=4,
    )


class _Announcement(event.Listener):
    """Say once in a process that something is being compiled: no silent wait."""

    def __init__(self) -> None:
        self.said = False

    def on_start(self, event: event.Event) -> None:
        function = getattr(event.data.get("dispatcher"), "py_func", None)
        if self.said or function not in _compiled_here:
            return
        self.said = True
        # One write: processes that compile side by side share the terminal.
        sys.stderr.write(
            "lpv-track-env: compiling numerical code (some seconds, once; then kept on disk) ...\n"
        )
        sys.stderr.flush()

    def on_end(self, event: event.Event) -> None:
        pass


class _Accelerator(event.Listener):
    """Shorten the time to compile, from the start of the outermost function to its end.

    The garbage collector is off, which saves a tenth: the objects that numba builds survive, so it
    would walk an ever larger heap and free little.

    The types that numba infers for operations on plain numbers are remembered, which saves an
    eighth: without this, numba tries every meaning of a product (of strings, lists, arrays, ...)
    for each product of two floats.
    """

    def __init__(self) -> None:
        self.depth, self.collected = 0, False
        self.plain = BaseFunction.get_call_type
        self.known: dict[tuple[int, tuple[Any, ...]], Any] = {}
        # References to the functions in `known`, so that no other object gets their ids.
        self.functions: dict[int, Any] = {}

    def on_start(self, event: event.Event) -> None:  # noqa: ARG002  part of the protocol
        self.depth += 1
        if self.depth > 1:
            return
        self.collected = gc.isenabled()
        gc.disable()
        known, functions, plain = self.known, self.functions, self.plain

        def get_call_type(function: Any, context: Any, args: Any, kws: Any) -> Any:
            if kws or not all(type(kind) in NUMBERS for kind in args):
                return plain(function, context, args, kws)
            key = id(function), tuple(args)
            if key not in known:
                known[key] = plain(function, context, args, kws)
                functions[id(function)] = function
            return known[key]

        setattr(BaseFunction, "get_call_type", get_call_type)  # noqa: B010

    def on_end(self, event: event.Event) -> None:  # noqa: ARG002  part of the protocol
        self.depth -= 1
        if self.depth > 0:
            return
        setattr(BaseFunction, "get_call_type", self.plain)  # noqa: B010
        self.known.clear()
        self.functions.clear()
        if self.collected:
            gc.enable()


for _listener in (_Announcement(), _Accelerator()):
    event.register("numba:compile", _listener)  # type: ignore[no-untyped-call]
