"""Results in little memory: what many of them have in common is kept once."""

from array import array
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import msgspec

MOST_SHARED = 200_000
"""Most values that are remembered to be shared; beyond, values are no longer compared."""


class Packed(Mapping[str, Any]):
    """Read-only mapping: values in a tuple or array, their places by name shared with others."""

    __slots__ = ("_places", "_values")

    def __init__(self, places: Mapping[str, int], values: Sequence[Any]) -> None:
        self._places, self._values = places, values

    def __getitem__(self, name: str) -> Any:
        return self._values[self._places[name]]

    def get(self, name: str, default: Any = None) -> Any:
        """Return the value of a name, or the default without it."""
        place = self._places.get(name)
        return default if place is None else self._values[place]

    def __contains__(self, name: object) -> bool:
        return name in self._places

    def __iter__(self) -> Iterator[str]:
        return iter(self._places)

    def __len__(self) -> int:
        return len(self._places)

    def __repr__(self) -> str:
        return repr(dict(self))


class Sharing:
    """Makes results compact; those that one object made share equal names, texts and settings."""

    def __init__(self) -> None:
        self._places: dict[tuple[str, ...], dict[str, int]] = {}
        self._known: dict[str | bytes, Any] = {}

    def compact(self, result: Mapping[str, Any]) -> Packed:
        """Return a result, plain JSON without a trace, as a compact read-only mapping."""
        values = [
            self._packed(value) if key in ("metrics", "solver") else self._shared(value)
            for key, value in result.items()
        ]
        return Packed(self._places_of(result), tuple(values))

    def _packed(self, found: Mapping[str, Any]) -> Packed:
        values = found.values()
        numbers = set(map(type, values)) == {float}
        packed = array("d", values) if numbers else tuple(map(self._shared, values))
        return Packed(self._places_of(found), packed)

    def _places_of(self, found: Mapping[str, Any]) -> Mapping[str, int]:
        names = tuple(found)
        places = self._places.get(names)
        if places is None:
            places = {name: place for place, name in enumerate(names)}
            if len(self._places) < MOST_SHARED:
                self._places[names] = places
        return places

    def _shared(self, value: Any) -> Any:
        """Return an equal value that was seen before, or else this one; numbers stay."""
        kind = type(value)
        if kind is str:
            key: str | bytes = value
        elif kind is dict or kind is list:
            # JSON tells 1, 1.0 and true apart, which are equal to Python.
            key = msgspec.json.encode(value)
        else:
            return value
        if len(self._known) >= MOST_SHARED:
            return self._known.get(key, value)
        return self._known.setdefault(key, value)
