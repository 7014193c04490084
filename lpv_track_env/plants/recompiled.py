"""Somebody else's plain numerical functions, compiled as they stand."""

import inspect
from collections.abc import Callable
from types import FunctionType, ModuleType
from typing import Any

from trajectories.compilation import compiled_with_lists


def recompiled(function: Callable[..., Any]) -> Callable[..., Any]:
    """Compile a function of another package, and the functions of that package that it calls.

    numba compiles what a function calls only if that is compiled itself. So each is bound anew, its
    code untouched, to globals in which the functions are compiled ones.

    Parameters
    ----------
    function
        A plain function of numbers, arrays and lists of floats, as are those that it calls, by
        their names or as attributes of modules.
    """
    compiled: Callable[..., Any] = _Recompiler(_package(function.__module__)).function(function)
    return compiled


def _package(module: str) -> str:
    return module.partition(".")[0]


class _Recompiler:
    """Binds each function and each module of a package once."""

    def __init__(self, package: str) -> None:
        self.package = package
        self.known: dict[Any, Any] = {}

    def function(self, function: Any) -> Any:
        if function not in self.known:
            code = function.__code__
            bound = FunctionType(code, self.bindings(function.__globals__, code.co_names))
            self.known[function] = compiled_with_lists()(bound)
        return self.known[function]

    def module(self, module: ModuleType) -> ModuleType:
        if module not in self.known:
            bound = ModuleType(module.__name__)
            bound.__dict__.update(self.bindings(vars(module), tuple(vars(module))))
            self.known[module] = bound
        return self.known[module]  # type: ignore[no-any-return]

    def bindings(self, names: dict[str, Any], used: tuple[str, ...]) -> dict[str, Any]:
        """Names as they are, those in use of the package's functions and modules compiled."""
        bound = dict(names)
        for name in used:
            value = names.get(name)
            if inspect.isfunction(value) and _package(value.__module__) == self.package:
                bound[name] = self.function(value)
            elif inspect.ismodule(value) and _package(value.__name__) == self.package:
                bound[name] = self.module(value)
        return bound
