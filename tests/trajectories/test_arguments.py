"""Rules of arguments: which numbers they take, as what, and what they say of all others."""

import math
from collections.abc import Iterator
from decimal import Decimal
from fractions import Fraction
from typing import Any

import numpy as np
import pytest

from trajectories.arguments import Number, Whole, array, flag, instance_of, numbers
from trajectories.naming import choose


class Raises:
    """Answers every question about itself with an exception."""

    def __float__(self) -> float:
        raise RuntimeError

    def __index__(self) -> int:
        raise RuntimeError

    def __repr__(self) -> str:
        raise RuntimeError

    def __eq__(self, other: object) -> bool:
        raise RuntimeError

    def __hash__(self) -> int:
        raise RuntimeError

    def __iter__(self) -> Iterator[Any]:
        raise RuntimeError

    @property
    def ndim(self) -> int:
        raise RuntimeError


class RaisingFloat(float):
    """A float that cannot be converted."""

    def __float__(self) -> float:
        raise RuntimeError


def deep() -> list[Any]:
    nested: list[Any] = []
    for _ in range(5000):
        nested = [nested]
    return nested


NO_NUMBERS: dict[str, Any] = {
    "none": None, "bool": True, "numpy-bool": np.True_, "text": "1", "long": "x\n" * 250_000,
    "bytes": b"1", "list": [1.0], "deep": deep(), "vector": np.array([1.0]), "complex": 1 + 0j,
    "huge": 10**400, "digits": 10**5000, "nan": math.nan, "inf": math.inf, "decimal": Decimal(1),
    "raises": Raises(), "raising-float": RaisingFloat(0.5), "class": float,
    "longdouble": np.longdouble("1e4000"), "array-of-objects": np.array(None, dtype=object),
    "array-of-bool": np.array(True),
}  # fmt: skip


def refusal(call: Any, *arguments: Any) -> str:
    with pytest.raises(ValueError) as told:  # noqa: PT011  every message is looked at
        call(*arguments)
    said = str(told.value)
    assert "\n" not in said
    assert len(said) < 300
    return said


@pytest.mark.parametrize("value", NO_NUMBERS.values(), ids=NO_NUMBERS)
@pytest.mark.parametrize("rule", [Number(), Number(0.0, 1.0, "s"), Whole(-5, 5)], ids=str)
def test_what_is_no_number_is_refused_in_one_line(rule: Number | Whole, value: Any) -> None:
    assert refusal(rule.of, "gain", value).startswith(f"gain must be {rule}, not ")


@pytest.mark.parametrize("value", NO_NUMBERS.values(), ids=NO_NUMBERS)
def test_names_and_vectors_are_refused_in_one_line(value: Any) -> None:
    assert refusal(choose, "agent", value, ("pid", "lqr")).startswith("unknown agent ")
    assert refusal(numbers, "gains", value, Number(), 2).startswith("gains must be 2 numbers")
    assert refusal(instance_of, "model", value, dict, "a table").startswith("model must be a table")


@pytest.mark.parametrize(
    "value",
    [1, 1.0, np.float32(1), np.float64(1), np.int64(1), np.array(1), np.array(1.0), Fraction(1)],
    ids=lambda value: type(value).__name__,
)
def test_numbers_of_any_type_become_plain_ones(value: Any) -> None:
    number = Number(0.0, 1.0).of("gain", value)
    assert type(number) is float
    assert number == 1.0


@pytest.mark.parametrize("value", [3, np.int64(3), np.uint8(3), np.array(3)])
def test_whole_numbers_of_any_type_become_plain_ones(value: Any) -> None:
    number = Whole(3, 3).of("steps", value)
    assert type(number) is int
    assert number == 3
    assert refusal(Whole(0, 9).of, "steps", 3.0).endswith("not 3.0")


def test_tensors_are_numbers() -> None:
    torch = pytest.importorskip("torch", reason="torch is not installed")
    given = torch.tensor(0.5, requires_grad=True)
    assert Number().of("gain", given) == 0.5
    assert "tensor" in refusal(Number().of, "gain", given[None].repeat(2))
    with pytest.raises(ValueError, match="positions must be numbers"):
        array("positions", torch.tensor([0.5], requires_grad=True))
    assert numbers("x", torch.tensor([1.0, 2.0]), Number(), 2) == (1.0, 2.0)


@pytest.mark.parametrize(
    ("rule", "inside", "outside", "words"),
    [
        (Number(), (-1e308, 0.0), (math.inf, -math.inf), "a finite number"),
        (Number(0.0), (0.0, 1e308), (-1e-300, math.inf), ">= 0 and finite"),
        (Number(0.0, above=True), (5e-324,), (0.0, -0.0), "positive and finite"),
        (Number(0.0, math.inf, "m", above=True), (math.inf,), (0.0,), "positive m"),
        (Number(0.0, math.inf), (0.0, math.inf), (-1.0,), ">= 0"),
        (Number(0.0, 2.0, "s"), (0.0, 2.0), (2.1, -0.1), ">= 0 and at most 2 s"),
        (Number(1.0, 2.0, above=True), (1.1, 2.0), (1.0, 2.1), "in (1, 2]"),
        (Number(-1.0, 1.0, "rad"), (-1.0, 1.0), (1.1,), "in [-1, 1] rad"),
    ],
    ids=str,
)
def test_bounds_are_said_and_kept(
    rule: Number, inside: tuple[float, ...], outside: tuple[float, ...], words: str
) -> None:
    assert str(rule) == words
    for value in inside:
        assert rule.of("x", value) == value
    for value in outside:
        refusal(rule.of, "x", value)


def test_flags() -> None:
    assert [flag("x", value) for value in (True, False, np.True_, 1, 0)] == [
        True, False, True, True, False,
    ]  # fmt: skip
    for value in (None, "no", 2, 1.0, [], Raises()):
        assert refusal(flag, "x", value).startswith("x must be True or False, not ")


def test_vectors() -> None:
    for value in ([1, 2], (1.0, 2.0), np.array([1, 2])):
        assert numbers("x", value, Number(), 2) == (1.0, 2.0)
    assert refusal(numbers, "x", [1.0, None], Number(), 2).startswith("x[1] must be a finite")


def test_a_long_name_is_compared_with_the_known_ones_at_once() -> None:
    said = refusal(choose, "agent", "stanly" * 100_000, ("stanley", "pid"))
    assert "nearest: stanley" in said
