"""Settings: all that the cases of one table have in common, and their titles."""

import hashlib
import json
from collections.abc import Mapping
from functools import lru_cache
from typing import Any, NamedTuple

import msgspec

from experiments.run.case import Case

Result = Mapping[str, Any]

LONGEST, CUT = 80, 48
"""Most characters of a setting's value in a label, and those that are kept of a longer one."""


class Setting(NamedTuple):
    """Everything that cases of one table share: all of a case but agent, trajectory and seed.

    Mappings are kept as JSON text, so that settings can be compared and be keys. Raw waypoints are
    a setting of their own: averaged with drivable paths they would say nothing about either.
    """

    vehicle: str
    vehicle_changes: str
    speed_mode: str
    fixed_speed: float | None
    grip: float | None
    raw: bool
    conditions: str
    computing: str
    control_period: float
    env_settings: str
    regime: str = ""
    start: str = "{}"
    """Where a vehicle starts; a regime holds cases with many starts."""

    @property
    def family(self) -> "Setting":
        """The setting under the default conditions: settings that differ only in these share it."""
        return self._replace(conditions=DEFAULT.conditions)

    @property
    def departures(self) -> int:
        """Number of entries that are not the default."""
        return sum(own != usual for own, usual in zip(self, DEFAULT, strict=True))

    def __str__(self) -> str:
        """Title of the setting's tables."""
        return _title(self)


@lru_cache(maxsize=4096)
def _title(setting: Setting) -> str:
    parts = [setting.regime, setting.vehicle] if setting.regime else [setting.vehicle]
    if changed := json.loads(setting.vehicle_changes):
        parts.append(f"with {changes_words(changed)}")
    speed = "" if setting.fixed_speed is None else f" {setting.fixed_speed} m/s"
    grip = None if setting.grip is None else f"{setting.grip} of grip"
    parts.append(grip or f"{setting.speed_mode} speed{speed}")
    if setting.raw:
        parts.append("raw waypoints")
    if setting.conditions != DEFAULT.conditions:
        parts.append(f"conditions {conditions_words(json.loads(setting.conditions))}")
    if computing := json.loads(setting.computing):
        arrangement = computing.get("arrangement", "?")
        parts.append(f"computing {arrangement} x {computing.get('load', 1):g}")
    if setting.control_period != DEFAULT.control_period:
        parts.append(f"control period {setting.control_period} s")
    if changed := json.loads(setting.env_settings):
        parts.append(f"env {changes_words(changed)}")
    if changed := json.loads(setting.start):
        parts.append(f"start {changes_words(changed)}")
    return " · ".join(parts)


def setting_of(case: Result) -> Setting:
    """Return the setting of a case; entries that an old result lacks are the default."""

    def text(name: str, default: Any) -> str:
        value = case.get(name) or default
        return msgspec.json.encode(value, order="sorted").decode() if value else "{}"

    return Setting(
        vehicle=str(case.get("vehicle", "?")),
        vehicle_changes=text("vehicle_changes", {}),
        speed_mode=str(case.get("speed_mode", "?")),
        fixed_speed=case.get("fixed_speed"),
        grip=case.get("grip"),
        raw=str(case.get("trajectory")).endswith("-raw"),
        conditions=text("conditions", Case.conditions),
        computing=text("computing", {}),
        control_period=case.get("control_period", Case.control_period),
        env_settings=text("env_settings", {}),
        regime=str(case.get("regime") or ""),
        start="{}" if case.get("regime") else text("start", {}),
    )


USUAL = Case("", "").as_dict()
DEFAULT = setting_of(USUAL)


def changes_words(values: Mapping[str, Any]) -> str:
    """Return fields and their values in a line, in the order of their names."""
    return ", ".join(f"{key}={_value_words(values[key])}" for key in sorted(values))


def _value_words(value: Any) -> str:
    """Return a setting's value in a line; a long one is cut, its digest keeping it apart."""
    if isinstance(value, Mapping):
        value = f"{{{changes_words(value)}}}"
    text = str(value)
    if len(text) <= LONGEST:
        return text
    return f"{text[:CUT]}… #{hashlib.sha256(text.encode()).hexdigest()[:6]}"


def conditions_words(given: str | Mapping[str, Any]) -> str:
    """Return the name of conditions and the fields that depart from them."""
    if isinstance(given, str):
        return given
    rest = {key: value for key, value in given.items() if key != "name"}
    name = str(given.get("name", "ideal"))
    return f"{name} with {changes_words(rest)}" if rest else name
