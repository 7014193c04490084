"""Entries of a written result that make it reproducible: revision, versions, hardware, load."""

import hashlib
import importlib.metadata
import importlib.util
import json
import os
import platform
import re
import subprocess
import sys
from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any

from trajectories.arguments import shortened

PACKAGES = (
    "lpv-track-env", "numpy", "scipy", "numba", "llvmlite", "casadi", "gymnasium", "torch",
    "stable-baselines3", "highway-env", "cma", "piqp", "rosbags", "commonroad-vehicle-models",
)  # fmt: skip
"""Packages that results depend on; the optional ones are listed where they are installed."""
COMPUTING = ("numpy", "scipy", "numba", "llvmlite", "casadi", "gymnasium")
"""Packages that compute every result: their versions are part of a case's id."""
OPTIONAL = ("torch", "stable-baselines3", "piqp", "highway-env", "commonroad-vehicle-models")
"""Packages that a user's own agent may compute with, where they are installed."""
HERE = Path(__file__).parent
RUN = ("case", "rollout", "metrics", "computing", "learning_cost", "search", "traffic")
"""Modules of this folder that a result depends on."""
FEATURES = re.compile(r"s?sse|avx|fma|f16c|xop|neon|fp-armv8|fullfp16|dotprod|bf16|sve|sme|vsx")
"""Beginnings of the processor features that decide how floating-point numbers are computed."""


def provenance() -> dict[str, Any]:
    """Return `revision`, `versions` and `hardware`, the entries of every written result."""
    return {"revision": revision(), "versions": versions(), "hardware": hardware()}


def measured_on(*further: str) -> dict[str, Any]:
    """Return `command` and `machine`, the entries of a result that depends on speed.

    `machine` has hardware, versions (see `versions`), revision and the load average before; the
    load average after is None until the measurement has ended.
    """
    return {
        "command": command_line(),
        "machine": {
            **hardware(),
            "versions": versions(*further),
            "revision": revision(),
            "load_average_before": load_average(),
            "load_average_after": None,
        },
    }


def command_line() -> list[str]:
    """Return the words of the running command, its program without folders."""
    return [Path(sys.argv[0]).name, *sys.argv[1:]]


def load_average() -> list[float] | None:
    """Return the load average over 1, 5 and 15 minutes, or None if the system has none."""
    return list(os.getloadavg()) if hasattr(os, "getloadavg") else None


@cache
def project_digest() -> str:
    """Return the digest of all sources that a result depends on."""
    # Imported late: it loads Numba.
    from trajectories.compilation import source_digest

    folders = [_folder(package) for package in ("trajectories", "lpv_track_env", "agents")]
    own = "".join((HERE / f"{name}.py").read_text("utf-8") for name in RUN)
    return hashlib.sha256((source_digest(*folders) + own).encode()).hexdigest()[:16]


def _folder(package: str) -> Path:
    """Return a package's folder, without importing it."""
    found = importlib.util.find_spec(package)
    assert found is not None
    assert found.origin is not None
    return Path(found.origin).parent


def revision() -> dict[str, Any]:
    """Return the digest of the `sources`; of a checkout also `commit` and whether it is `modified`.

    An installed wheel has no commit, even inside another project's checkout.
    """

    def git(*arguments: str) -> str | None:
        try:
            done = subprocess.run(  # noqa: S603  fixed arguments
                ["git", "-C", str(HERE), *arguments],  # noqa: S607
                capture_output=True, text=True, timeout=10, check=False,
            )  # fmt: skip
        except (OSError, subprocess.TimeoutExpired):
            return None
        return done.stdout.strip() if done.returncode == 0 else None

    found: dict[str, Any] = {"sources": project_digest()}
    file = Path(__file__).name
    if git("ls-files", "--full-name", "--error-unmatch", file) == f"experiments/run/{file}":
        changes = git("status", "--porcelain", "--untracked-files=no")
        found |= {"commit": git("rev-parse", "HEAD"), "modified": bool(changes)}
    return found


def versions(*further: str) -> dict[str, str]:
    """Return the versions of Python, of `PACKAGES` and of `further` packages, if installed."""
    return {"python": platform.python_version(), **_installed(*PACKAGES, *further)}


@cache
def computing_versions(*packages: str) -> dict[str, str]:
    """Return what may change the last digits of a result: versions of packages that compute.

    Python counts by its minor version, the machine by its architecture.
    """
    python = ".".join(platform.python_version_tuple()[:2])
    return {"python": python, "machine": platform.machine(), **_installed(*packages)}


@cache
def manifest_key() -> str:
    """Return the key of all that last digits depend on: versions, sources, processor features."""
    present = [versions(), project_digest(), platform.machine(), *processor_features()]
    return hashlib.sha256(json.dumps(present, sort_keys=True).encode()).hexdigest()[:8]


def version_changes(before: Mapping[str, Any]) -> list[str]:
    """Return where versions differ from a manifest's, as "numpy 2.1.0 instead of 2.2.0"."""
    changed = _changed_versions(before, ("python", *COMPUTING, *OPTIONAL))
    return [f"{name} {then} instead of {now}" for name, then, now in changed if then and now]


def changes_since(before: Mapping[str, Any], packages: Sequence[str]) -> dict[str, list[str]]:
    """Return in words what differs here from a manifest: `versions`, `sources`, `processor`.

    An entry that the manifest lacks counts as different. Versions are those of `packages`; Python
    counts by its minor version. Texts of the manifest, which anybody may have written, are cut.
    """
    changed = _changed_versions(before, ("python", *packages))
    versions = [
        f"{name} {then or 'none'} there, {now or 'none'} here"
        for name, then, now in changed
        if name != "python" or _minor(then) != _minor(now)
    ]
    found = {"versions": versions, "sources": [], "processor": []}
    if not isinstance(before.get("versions"), Mapping):
        found["versions"] = ["versions not known"]
    there = _entry(before, "revision")
    if not (there.get("sources") or there.get("commit")):
        found["sources"] = ["sources not known"]
    elif there.get("sources") != project_digest():
        found["sources"] = [f"sources {_sources(there)} there, {_sources(revision())} here"]
    there, (name, features) = _entry(before, "hardware"), processor_features()
    known = there.get("features")
    if not isinstance(known, list):
        found["processor"] = ["processor features not known"]
    elif there.get("architecture") != name or set(map(str, known)) != set(features):
        words = [f"processor {shortened(there.get('architecture'), 40)} there, {name} here"]
        for place, more, less in (("there", known, features), ("here", features, known)):
            if only := [one for one in map(str, more) if one not in less]:
                words.append(f"with {shortened(' '.join(only), 60)} only {place}")
        found["processor"] = [" ".join(words)]
    return found


def _changed_versions(
    before: Mapping[str, Any], names: Sequence[str]
) -> list[tuple[str, str | None, str | None]]:
    """Return name, version in a manifest and version here of the packages where they differ."""
    then, now = _entry(before, "versions"), versions()
    return [
        (name, shortened(then[name], 40) if name in then else None, now.get(name))
        for name in names
        if then.get(name) != now.get(name)
    ]


def _entry(manifest: Mapping[str, Any], name: str) -> Mapping[str, Any]:
    found = manifest.get(name)
    return found if isinstance(found, Mapping) else {}


def _minor(version: object) -> list[str]:
    return str(version).split(".")[:2]


def _sources(told: Mapping[str, Any]) -> str:
    """Say which sources a manifest's `revision` tells of."""
    words = [shortened(told["sources"], 40)] if told.get("sources") else []
    if told.get("commit"):
        changed = ", modified" if told.get("modified") else ""
        words.append(f"(commit {shortened(str(told['commit'])[:12])}{changed})")
    return " ".join(words)


def _installed(*packages: str) -> dict[str, str]:
    found = {}
    for package in packages:
        try:
            found[package] = importlib.metadata.version(package)
        except importlib.metadata.PackageNotFoundError:
            continue
    return found


@cache
def processor_features() -> tuple[str, tuple[str, ...]]:
    """Return LLVM's name of the processor, and its features that matter to numerics.

    Numba compiles for both; OpenBLAS chooses its kernels likewise.
    """
    # Slow to import, and needed only here.
    from llvmlite import binding

    features = binding.get_host_cpu_features()
    names = sorted(name for name, there in features.items() if there and FEATURES.match(name))
    return str(binding.get_host_cpu_name()), tuple(names)


def hardware() -> dict[str, Any]:
    """Return processor, its features (`processor_features`), cores, memory (GiB) and system."""
    processor = platform.processor() or platform.machine()
    memory = None
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        names = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
        processor = names[0] if names else processor
        pages, size = os.sysconf("SC_PHYS_PAGES"), os.sysconf("SC_PAGE_SIZE")
        memory = round(pages * size / 2**30, 1)
    except (OSError, ValueError):
        pass
    architecture, features = processor_features()
    return {
        "processor": processor,
        "architecture": architecture,
        "features": list(features),
        "cores": os.cpu_count(),
        "memory_gib": memory,
        "system": platform.system(),
    }


def file_digest(file: Path) -> str:
    """Return the SHA-256 of a file's content in hexadecimal."""
    return hashlib.sha256(file.read_bytes()).hexdigest()
