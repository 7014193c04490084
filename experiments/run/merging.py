"""Join folders of results, such as the shards of one benchmark, into one."""

import hashlib
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from experiments.run.exact import OUTCOMES, values_of
from experiments.run.folder_lock import TRACES, locked
from experiments.run.store import LARGEST_TRACE, ResultStore, write_json
from trajectories.arguments import shortened, shown
from trajectories.fileio import read_bytes, write_atomically


class Held(NamedTuple):
    """Result of an id: number of the folder that holds it, status, digest of its values."""

    folder: int
    status: str
    digest: bytes


class Merged(NamedTuple):
    """Outcome of `merge`: cases in the folder, those that were added, lines that were left out."""

    cases: int
    added: int
    skipped: list[str]


def merge(
    out: Path, folders: Sequence[Path], done: Callable[[int, int], None] = lambda *_: None
) -> Merged:
    """Join the cases, traces and manifests of folders in `out`, which may hold results already.

    A case that several folders hold must have the same values in all, times apart; if it failed in
    one and succeeded in another, the success is kept. Everything is compared before anything is
    written. After an interruption, the same call completes `out`.

    Parameters
    ----------
    out
        Folder of the joined results, made if need be; locked meanwhile.
    folders
        Folders to join, which are only read.
    done
        Receives the numbers of cases that were written and that are to be.

    Raises
    ------
    ValueError
        In one line: for a folder without results, one that is `out`, one whose files are links, or
        a case with two values of a metric.
    """
    for folder in folders:
        if folder.resolve() == out.resolve():
            raise ValueError(f"{shortened(folder)}: cannot be merged into itself")
        if not (folder / "cases.jsonl").is_file():
            raise ValueError(f"{shortened(folder)}: holds no results to merge")
    with locked(out):
        stores = [ResultStore(folder) for folder in (out, *folders)]
        for store in stores:
            _refuse_links(store)
        skipped: list[str] = []
        chosen = _chosen(stores, skipped)
        missing = {key: held for key, held in chosen.items() if held.folder}
        total = len(missing)
        with stores[0] as joined:
            for place, store in enumerate(stores[1:], start=1):
                for result in store.stream([]):
                    own = missing.get(result["id"])
                    if own is None or own != _held(place, result):
                        continue
                    _copy_trace(store, joined, result["id"], skipped)
                    joined.append(result)
                    del missing[result["id"]]
                    done(total - len(missing), total)
        _join_manifests(stores, list(chosen))
    return Merged(len(chosen), total, skipped)


def _chosen(stores: Sequence[ResultStore], skipped: list[str]) -> dict[str, Held]:
    """Return the result to take for every id, after comparing those of several folders.

    Messages on lines that cannot be read go to `skipped`.
    """
    chosen: dict[str, Held] = {}
    for place, store in enumerate(stores):
        # The last of several lines with one id counts.
        found = {result["id"]: _held(place, result) for result in store.stream(skipped)}
        for key, new in found.items():
            old = chosen.setdefault(key, new)
            if "failed" in (old.status, new.status):
                chosen[key] = new if old.status == "failed" and new.status == "ok" else old
            elif old.digest != new.digest:
                _refuse(key, stores[old.folder], store)
    return chosen


def _held(place: int, result: Mapping[str, Any]) -> Held:
    content = repr(_canonical(_compared(result))).encode()
    return Held(place, result["status"], hashlib.blake2b(content, digest_size=16).digest())


def _canonical(value: Any) -> Any:
    """Return plain JSON in a form whose text is the same for equal values, such as 1 and 1.0."""
    if isinstance(value, Mapping):
        return sorted((key, _canonical(inner)) for key, inner in value.items())
    if isinstance(value, list | tuple):
        return [_canonical(inner) for inner in value]
    if isinstance(value, int | float) and float(value) == value:
        return float(value) + 0.0  # -0.0 is 0.0
    return value


def _compared(result: Mapping[str, Any]) -> dict[str, Any]:
    """Return the values of a result, times apart, and what was driven, by dotted names."""
    driven = {key: value for key, value in result.items() if key not in OUTCOMES}
    return {**driven, **dict(values_of(result))}


def _refuse(key: str, first: ResultStore, second: ResultStore) -> None:
    """Refuse two results of one id whose values differ; 1 and 1.0 are equal."""
    old, new = _last(first, key), _last(second, key)
    for name in sorted({*old, *new}):
        if name not in old or name not in new or old[name] != new[name]:
            values = [shown(one[name]) if name in one else "missing" for one in (old, new)]
            raise ValueError(
                f"case {key}: {name} is {values[0]} in {shortened(first.folder)} and {values[1]} "
                f"in {shortened(second.folder)}: nothing was merged"
            )


def _last(store: ResultStore, key: str) -> dict[str, Any]:
    last: dict[str, Any] = {}
    for result in store.stream([]):
        if result["id"] == key:
            last = _compared(result)
    return last


def _refuse_links(store: ResultStore) -> None:
    """Refuse a folder with links: one of a stranger's could bring any file of ours into `out`.

    Raises
    ------
    ValueError
        In one line that names the link.
    """
    parts = [store.cases_file, store.folder / TRACES, *store.folder.glob("manifest*.json")]
    for part in parts:
        if part.is_symlink():
            raise ValueError(f"{shortened(part)} is a link: merge takes no files from elsewhere")


def _copy_trace(source: ResultStore, target: ResultStore, case_id: str, skipped: list[str]) -> None:
    """Copy the trace of a case as it is, if there is one; a link is left out."""
    file = source.folder / TRACES / f"{case_id}.npz"
    if file.is_symlink():
        skipped.append(f"{shortened(file)}: is a link")
    elif file.is_file():
        write_atomically(target.folder / TRACES / file.name, read_bytes(file, LARGEST_TRACE))


def _join_manifests(stores: Sequence[ResultStore], cases: list[str]) -> None:
    """Write the first folder's manifest with all cases, and those with other keys beside it.

    Its setting `merged` names folder, command and shard of each part.
    """
    every: dict[str, dict[str, Any]] = {}
    for store in stores:
        every = {**store.manifests(), **every}
    main = next((found for store in stores if (found := store.manifest())), {})
    parts = list(_settings(main).get("merged") or [])
    for store in stores[1:]:
        own = store.manifest()
        part = {
            "folder": store.folder.name,
            "command": own.get("command"),
            "shard": _settings(own).get("shard"),
        }
        parts += [part] if part not in parts else []
    settings = {key: value for key, value in _settings(main).items() if key != "shard"}
    joined = {**main, "settings": {**settings, "merged": parts, "cases": cases}}
    for key, manifest in every.items():
        if key != main.get("key", "before"):
            write_json(stores[0].folder / f"manifest-{key}.json", manifest)
    write_json(stores[0].folder / "manifest.json", joined)


def _settings(manifest: Mapping[str, Any]) -> dict[str, Any]:
    found = manifest.get("settings")
    return dict(found) if isinstance(found, dict) else {}
