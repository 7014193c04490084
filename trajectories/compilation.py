"""Compile numerical functions with numba, cached on disk, never stale."""

import hashlib
import sys
import warnings
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any, TypeVar

import numba
from numba.core import event, types
from numba.core.registry import CPUDispatcher

from trajectories.compile_time import Arithmetic, Collector

Function = TypeVar("Function", bound=Callable[..., Any])


@cache
def source_digest(*folders: Path) -> str:
    """Digest of all Python sources in some folders.

    numba notices a change in the file of a cached function, not in what that function calls or in
    a constant it imports: this digest closes the gap.
    """
    digest = hashlib.sha256()
    for folder in folders:
        for file in sorted(folder.rglob("*.py")):
            name = file.relative_to(folder.parent).as_posix()
            digest.update(name.encode() + b"\0" + file.read_bytes())
    return digest.hexdigest()


@cache
def _warn_of_no_cache() -> None:
    warnings.warn(
        "numba finds no writable cache folder: compiling anew in this process "
        "(set NUMBA_CACHE_DIR to a writable folder to avoid the wait)",
        RuntimeWarning,
        stacklevel=4,
    )


def _package(folder: Path) -> Path:
    """Topmost package that a folder is in, or the folder itself."""
    while (folder.parent / "__init__.py").is_file():
        folder = folder.parent
    return folder


class _Announcement(event.Listener):
    """Says once in a process that something is being compiled: no silent wait."""

    def __init__(self) -> None:
        self.said = False

    def on_start(self, event: event.Event) -> None:
        function = getattr(event.data.get("dispatcher"), "py_func", None)
        if (
            self.said
            or (getattr(function, "__module__", "") or "").partition(".")[0] not in PACKAGES
        ):
            return
        self.said = True
        # In one piece: processes that compile side by side share the terminal.
        sys.stderr.write(
            "lpv-track-env: compiling numerical code (some seconds, once; then kept on disk) ...\n"
        )
        sys.stderr.flush()

    def on_end(self, event: event.Event) -> None:
        pass


PACKAGES = ("trajectories", "lpv_track_env", "agents", "experiments")
for _listener in (_Announcement(), Collector(), Arithmetic()):
    event.register("numba:compile", _listener)  # type: ignore[no-untyped-call]


def compiled(function: Function) -> Function:
    """`numba.njit` with IEEE arithmetic, an on-disk cache, and division by zero giving inf.

    Where no cache folder is writable it warns once and compiles in every process.
    """
    return _compile(function)


def compiled_in_place(function: Function) -> Function:
    """`compiled`, and put into its callers by numba, as it stands.

    For large functions with few callers: each level of calls between large functions is optimised
    all over again, which takes seconds. Not for functions called from parallel loops.
    """
    return _compile(function, inline="always")


class _Internal(CPUDispatcher):
    """A compiled function without wrappers; a call from Python makes itself an entry first."""

    def __call__(self, *arguments: Any) -> Any:
        if not hasattr(self, "_entry"):
            internal = self
            self._entry = numba.njit(lambda *given: internal(*given))  # noqa: PLW0108
        return self._entry(*arguments)

    def get_call_template(self, args: Any, kws: Any) -> Any:
        # Without this, numba compiles a version of its own for every integer that callers write.
        plain = {name: _plain(kind) for name, kind in kws.items()}
        return super().get_call_template([_plain(kind) for kind in args], plain)


def _plain(kind: Any) -> Any:
    """Numba type of a literal integer's value, for its own; any other type as it is."""
    return kind.literal_type if isinstance(kind, types.IntegerLiteral) else kind


def compiled_internal(function: Function) -> Function:
    """`compiled`, for what compiled code calls: half the wait, for lack of wrappers.

    Unboxing a few arrays takes longer to compile than a short function that works on them. Python
    may call it too, but compiles an entry in each process: for tests.
    """
    return _compile_internal(function)


def compiled_inline(function: Function) -> Function:
    """`compiled_internal`, always inlined by LLVM: for a loop that is to be vectorised."""
    return _compile_internal(function, forceinline=True)


def compiled_parallel(function: Function) -> Function:
    """`compiled`, its `numba.prange` loops over threads: for loops that call one ordinary function.

    (A body that numba inlines into such a loop was seen to give wrong results.)
    """
    return _compile(function, parallel=True, _nrt=True)


def compiled_with_lists(*folders: Path) -> Callable[[Function], Function]:
    """`compiled`, for what makes lists or arrays, as the models of other packages do.

    `folders` hold further sources of what it calls: a change in them makes its cache stale, too.
    """
    return lambda function: _compile(function, *folders, _nrt=True)


def entry_point(function: Callable[..., Any], *arguments: Any) -> Callable[..., Any]:
    """What a call of a compiled function with such arguments ends in, compiled if need be.

    numba looks up the types of all arguments in every call, which takes as long as to pass them:
    0.2 us for a handful of arrays. This is the call without it. It takes only arguments of the very
    same types: an array of another layout would be misread.
    """
    if not isinstance(function, numba.core.dispatcher.Dispatcher):
        return function  # With NUMBA_DISABLE_JIT=1 it is plain Python.
    entry: Callable[..., Any] = function.compile(tuple(map(numba.typeof, arguments)))
    return entry


def _compile_internal(function: Function, **more: bool) -> Function:
    dispatcher: Any = _compile(function, no_cpython_wrapper=True, no_cfunc_wrapper=True, **more)
    if isinstance(dispatcher, CPUDispatcher):
        dispatcher.__class__ = _Internal
    return dispatcher  # type: ignore[no-any-return]


def _compile(function: Function, *sources: Path, **more: bool | str) -> Function:
    # Without numba's runtime there are no references to count, which takes a tenth of the time to
    # compile; no memory can be had either, but views of arrays can.
    options: dict[str, Any] = {"error_model": "numpy", "fastmath": False, "_nrt": False, **more}
    try:
        dispatcher = numba.njit(cache=True, **options)(function)
    except RuntimeError:
        _warn_of_no_cache()
        return numba.njit(**options)(function)  # type: ignore[no-any-return]
    here = Path(__file__).parent
    own = _package(Path(function.__code__.co_filename).parent)
    index = getattr(getattr(dispatcher, "_cache", None), "_cache_file", None)
    if index is not None and hasattr(index, "_source_stamp"):
        folders = dict.fromkeys((here, here.parent / "lpv_track_env", own, *sources))
        index._source_stamp = (index._source_stamp, source_digest(*folders))  # noqa: SLF001
    return dispatcher  # type: ignore[no-any-return]
