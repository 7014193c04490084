"""Checks of the arguments, actions, reset options, seeds and threads of environments.

A check returns the value in the form that its caller works with, or raises an error of one line.
"""

import functools
import inspect
import math
import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, ParamSpec

import numba
import numpy as np
from gymnasium.vector import AutoresetMode
from numpy.typing import NDArray

from lpv_track_env.episodes import GIVEN
from lpv_track_env.kernels import first_not_finite
from trajectories.arguments import Number, Whole, shown
from trajectories.naming import choose

Array = NDArray[Any]

ENTRIES = ("0 (acceleration)", "1 (steering angle)")
NUMBERS = (float, int)
LARGEST_ERROR = 1e15
"""Largest initial error, m, rad, m/s: within it all that an episode computes is finite."""
ERROR = Number(-LARGEST_ERROR, LARGEST_ERROR)
SEED = Whole(0, 2**63 - 1)

P = ParamSpec("P")


def refuse_unknown(given: Iterable[str], known: tuple[str, ...]) -> None:
    """Raise a TypeError that names the nearest argument, if a given name is not a known one."""
    for name in given:
        try:
            choose("argument", name, known)
        except ValueError as error:
            raise TypeError(str(error)) from None


def names_unknown(initialise: Callable[P, None]) -> Callable[P, None]:
    """Decorate an `__init__`: an unknown keyword argument is refused as in `refuse_unknown`."""
    known = tuple(inspect.signature(initialise).parameters)[1:]

    @functools.wraps(initialise)
    def checked(*arguments: P.args, **named: P.kwargs) -> None:
        refuse_unknown(named, known)
        initialise(*arguments, **named)

    return checked


def forwards_arguments(
    inner: type, *without: str, **defaults: Any
) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Decorate an `__init__` that takes the arguments of another class beside its own.

    The decorated function has the parameters `self`, `settings`, and its own. Its callers give its
    own and those of `inner`, by position or by name; `settings` gets those of `inner`, defaults
    included, in a dictionary.

    Parameters
    ----------
    inner
        The class whose arguments are forwarded.
    without
        Arguments of `inner` that are not taken.
    defaults
        Defaults in place of those of `inner`.
    """

    def decorate(initialise: Callable[..., None]) -> Callable[..., None]:
        instance, settings, *own = inspect.signature(initialise).parameters.values()
        excluded = {*without, *(parameter.name for parameter in own)}
        forwarded = [
            parameter.replace(default=defaults.get(parameter.name, parameter.default))
            for parameter in inspect.signature(inner).parameters.values()
            if parameter.name not in excluded
        ]
        # A stable sort: what may be given by position comes first, the function's own before.
        ordered = sorted([instance, *own, *forwarded], key=lambda parameter: parameter.kind)
        signature = inspect.Signature(ordered)
        known = tuple(signature.parameters)[1:]

        @functools.wraps(initialise)
        def checked(*arguments: Any, **named: Any) -> None:
            refuse_unknown(named, known)
            bound = signature.bind(*arguments, **named)
            bound.apply_defaults()
            taken = {parameter.name: bound.arguments.pop(parameter.name) for parameter in forwarded}
            initialise(**{settings.name: taken}, **bound.arguments)

        checked.__signature__ = signature  # type: ignore[attr-defined]
        return checked

    return decorate


def two_numbers(action: Any) -> tuple[float, float]:
    """Return the two real numbers that an action consists of.

    Raises
    ------
    ValueError
        For anything but two real numbers.
    """
    try:
        # Through plain Python values: they tell a number from text, bool or complex.
        values = np.asarray(action).tolist()
        a, delta = values
        if not (type(values) is list and type(a) in NUMBERS and type(delta) in NUMBERS):
            raise TypeError
        return float(a), float(delta)
    except Exception:  # noqa: BLE001  conversions of a user's object may raise anything
        raise ValueError(
            "action must be two numbers [acceleration m/s^2, steering angle rad], not "
            f"{shown(action)}"
        ) from None


def check_finite(a: float, delta: float, action: Any) -> None:
    """Raise a ValueError that names the first entry of an action that is not finite, if any."""
    for value, entry in zip((a, delta), ENTRIES, strict=True):
        if not math.isfinite(value):
            raise ValueError(f"action entry {entry} is not finite: {shown(action)}")


def check_action(action: Any) -> None:
    """Raise the ValueError with which `step` refuses an action, if it does."""
    a, delta = two_numbers(action)
    check_finite(a, delta, action)


def checked_actions(actions: Any, ends: Array, skips_ended: bool) -> Array:
    """Return actions as an array (n, 2) of numbers, after a check of those that are not ignored.

    `ends` (n,) are the environments' end codes; `skips_ended` ignores the actions of environments
    whose episode has ended.

    Raises
    ------
    ValueError
        For a wrong shape or type, or naming environment and entry that is not finite.
    """
    shape = (len(ends), 2)
    try:
        given = np.asarray(actions)
    except Exception:  # noqa: BLE001  conversions of a user's object may raise anything
        given = np.empty(0, dtype=object)
    if given.shape != shape or given.dtype.kind not in "fiu":
        raise ValueError(
            f"actions must be an array {shape} of numbers [acceleration m/s^2, steering angle "
            f"rad], not {given.shape} of {given.dtype}"
        )
    commands = np.ascontiguousarray(given, dtype=np.float64)
    bad = first_not_finite(commands, ends, skips_ended)
    if bad >= 0:
        index, entry = divmod(bad, 2)
        raise ValueError(
            f"action of environment {index}, entry {ENTRIES[entry]}, is not finite: "
            f"{shown(given[index])}"
        )
    return commands


def checked_mask(mask: Any, num_envs: int) -> Array:
    """Return a copy of a mask of environments (n,); None marks all.

    Raises
    ------
    TypeError, ValueError
        For another type, a wrong shape, or a mask that marks none.
    """
    if mask is None:
        return np.ones(num_envs, dtype=np.bool_)
    if not (isinstance(mask, np.ndarray) and mask.dtype == np.bool_):
        raise TypeError("options['reset_mask'] must be a NumPy array of dtype bool")
    if mask.shape != (num_envs,):
        raise ValueError(f"options['reset_mask'] must have shape ({num_envs},), not {mask.shape}")
    if not mask.any():
        raise ValueError("options['reset_mask'] must mark at least one environment")
    return mask.copy()


def checked_seeds(seed: Any, num_envs: int) -> Sequence[int | None]:
    """Return a seed for each environment, None for those without one.

    Raises
    ------
    ValueError
        For a list of another length, or anything but whole numbers >= 0 and None.
    """
    if not isinstance(seed, Sequence) or isinstance(seed, str | bytes):
        first = checked_seed(seed)
        return [None if first is None else first + i for i in range(num_envs)]
    if len(seed) != num_envs:
        raise ValueError(f"{len(seed)} seeds for num_envs={num_envs}: give one for each")
    return [checked_seed(one) for one in seed]


def checked_seed(seed: Any) -> int | None:
    """Return a seed as an int; None stays None.

    Raises
    ------
    ValueError
        For anything but a whole number >= 0.
    """
    return None if seed is None else SEED.of("seed", seed)


def checked_options(options: Any, known: tuple[str, ...]) -> dict[str, Any]:
    """Return reset options as a dictionary; None stands for none.

    Raises
    ------
    ValueError
        For another type, or an unknown option; the message lists the known ones and the nearest.
    """
    if options is None:
        return {}
    if not isinstance(options, Mapping):
        raise ValueError(f"options must be a dictionary or None, not {shown(options)}")  # noqa: TRY004
    for key in options:
        choose("reset option", key, known)
    return dict(options)


def listed(kind: str, value: Any) -> list[Any]:
    """Return the items of a list or tuple, or a list of the one item."""
    if not isinstance(value, list | tuple):
        return [value]
    if not value:
        raise ValueError(f"{kind}: an empty sequence")
    return list(value)


def checked_mode(value: AutoresetMode | str) -> AutoresetMode:
    """Return an autoreset mode, given as such or by its value."""
    if isinstance(value, AutoresetMode):
        return value
    known = tuple(mode.value for mode in AutoresetMode)
    return AutoresetMode(choose("autoreset_mode", value, known))


def checked_threads(value: int) -> int:
    """Return a number of threads that numba can use.

    Raises
    ------
    ValueError
        For fewer than one, or more than numba sees processors.
    """
    most: int = numba.config.NUMBA_NUM_THREADS  # type: ignore[attr-defined]
    try:
        threads = Whole(1, most).of("threads", value)
    except ValueError:
        raise ValueError(
            f"threads must be from 1 to {most} (the processors numba sees; NUMBA_NUM_THREADS sets "
            f"it), not {shown(value)}"
        ) from None
    if threads > 1:
        # Waiting threads would spin otherwise: on a busy machine a step then takes 700 times as
        # long.
        os.environ.setdefault("OMP_WAIT_POLICY", "passive")
    return threads


def checked_start(start: Any, length: float) -> NDArray[np.float64]:
    """Return what `given_start` does for a start alone, without options of other kinds."""
    return given_start(checked_options(start, GIVEN), length)


def given_start(options: Mapping[str, Any], length: float) -> NDArray[np.float64]:
    """Return the start that reset options give, (5,) in the order of `GIVEN`; NaN is drawn.

    Raises
    ------
    ValueError
        For a value that is not a finite number, an arc length outside of the path, or both a speed
        and an error of it.
    """
    if "speed" in options and "speed_error" in options:
        raise ValueError("reset options speed and speed_error: give one of them")
    start = np.full(len(GIVEN), math.nan)
    for k, key in enumerate(GIVEN):
        if key not in options:
            continue
        rule = Number(0.0, length, "m") if key == "arc_length" else ERROR
        start[k] = rule.of(f"reset option {key}", options[key])
    return start
