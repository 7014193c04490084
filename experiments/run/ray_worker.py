"""Worker side of the Ray engine: keeps a child process that runs one order after another.

An order and its answer are plain dictionaries. Runs take place in the child alone; if it dies or
exceeds its time, this process says so and starts another.
"""

import contextlib
import os
import pickle
import shutil
import sys
import tempfile
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any, cast

from experiments.run import provenance, shipping
from experiments.run.folder_lock import locked
from experiments.run.worker_process import (
    PATIENCE,
    Identity,
    Run,
    Worker,
    late,
    one_thread,
    pickled_exception,
    ready,
)

Order = Mapping[str, Any]
Answer = dict[str, Any]

CHILD_DIED = "died"
"""Kind of the answer for an order that killed its child process."""
OTHER_ID = "a case has another id there"
"""Reason of a refusal."""
ABSENT = "is not there, or differs: give names below the working directory"
LEFT_BY = "lpv-track-ray-"
"""Beginning of the names of workers' folders."""


def about() -> dict[str, Any]:
    """Return sources and versions, the same on all computers of a sweep, and provenance."""
    return {
        "sources": shipping.sources_digest(),
        "versions": provenance.computing_versions(*_packages()),
        "key": provenance.manifest_key(),
        "provenance": provenance.provenance(),
    }


def _packages() -> list[str]:
    # Sources have a digest of their own.
    return [name for name in provenance.PACKAGES if name != "lpv-track-env"]


class Host:
    """A child process and a folder, in which orders run.

    An order has `call`, see `packed`; the pickled `spec` and its `id`; `limit`, s; `files`, digests
    by name; `folder`, a relative name, with the `known` digests of its files, if it has one; or
    `token`, a file in a folder that must be here already.

    Its answer has `kind` and `content`: "done" with the pickled result, "failed" with the error of
    a run over its limit, `CHILD_DIED`, "refused" with the reason, or "raised" with what the run
    raised, pickled. With `folder` it has `changes`.
    """

    def __init__(self) -> None:
        one_thread()
        # A child process need not load Ray's own program again.
        vars(sys.modules["__main__"]).pop("__file__", None)
        _remove_leftovers()
        self._stack = contextlib.ExitStack()
        root = Path(tempfile.mkdtemp(prefix=LEFT_BY))
        self._stack.callback(shutil.rmtree, root, ignore_errors=True)
        self._stack.enter_context(locked(root))
        self._place = shipping.Place(root)
        self._child: Worker | None = None
        self._ended = False

    def lacks(self, files: Mapping[str, str]) -> list[str]:
        """Return the names of the files, given with their digests, that are not here yet."""
        return [name for name, digest in files.items() if not self._place.has(name, digest)]

    def take(
        self, order: Order, files: Mapping[str, bytes], content: Mapping[str, bytes] | None
    ) -> Answer:
        """Run an order once its files, and the content of its folder, have been written here."""
        for name in files:
            if self._place.file(name) is not None:
                self._place.lay(name, files[name])
        if absent := self.lacks(order["files"]):
            return {"kind": "refused", "content": f"{absent[0]} {ABSENT}"}
        if "token" in order and not Path(order["token"]).is_file():
            return {"kind": "refused", "content": f"{Path(order['token']).parent} {ABSENT}"}
        if content is None:
            return self.run(order)
        folder = self._place.file(order["folder"])
        if folder is None:
            return {"kind": "refused", "content": f"{order['folder']} {ABSENT}"}
        shutil.rmtree(folder, ignore_errors=True)
        for name in content:
            file = folder / name
            file.parent.mkdir(parents=True, exist_ok=True)
            file.write_bytes(content[name])
        answer = self.run(order)
        return {**answer, "changes": shipping.changes(folder, order["known"])}

    def changes(self, folder: str, known: Mapping[str, str]) -> shipping.Changes:
        """Return what has changed in the folder of the order that runs."""
        place = self._place.file(folder)
        assert place is not None
        return shipping.changes(place, known)

    def run(self, order: Order) -> Answer:
        """Run an order."""
        if self._ended:
            return {"kind": CHILD_DIED, "content": None}
        if self._child is None:
            self._child = Worker(cast("Any", _Packed(order["call"])))
        child, limit = self._child, order["limit"]
        child.give({**order, "place": str(self._place.folder)}, again=False)
        while True:
            ready([child], limit)
            message = child.message()
            if message:
                return message[0]
            if message is None:
                child.kill()
                self._child = None
                over = child.lasted > limit
                return {"kind": "failed" if over else CHILD_DIED, "content": late(limit)}

    def end(self) -> None:
        """End the child, and with it the order that runs."""
        self._ended = True
        if self._child is not None:
            self._child.process.kill()

    def close(self) -> None:
        """End the child and remove the folder."""
        self.end()
        if self._child is not None:
            self._child.process.join(PATIENCE)
        self._stack.close()


def _remove_leftovers() -> None:
    """Remove the folders of workers that were killed."""
    for folder in Path(tempfile.gettempdir()).glob(f"{LEFT_BY}*"):
        # It may be another process's, or be made or removed at this moment.
        with contextlib.suppress(ValueError, OSError):
            if folder.stat().st_uid == os.getuid() and any(folder.iterdir()):
                with locked(folder):
                    shutil.rmtree(folder, ignore_errors=True)


class _Packed:
    """A function that is unpickled in the child process alone, as that starts."""

    def __init__(self, content: bytes) -> None:
        self._content = content

    def __reduce__(self) -> tuple[Any, ...]:
        return pickle.loads, (self._content,)


def packed(run: Run, identity: Identity | None) -> bytes:
    """Pickle the function that runs a sweep's orders in a child process, for their `call`."""
    return pickle.dumps(partial(_run, run, identity))


def _run(run: Run, identity: Identity | None, order: Order) -> Answer:
    """Run an order in the child process."""
    try:
        spec = pickle.loads(order["spec"])  # noqa: S301  sent by the engine
        with contextlib.chdir(order["place"]):
            if identity is not None and identity(spec) != order["id"]:
                return {"kind": "refused", "content": OTHER_ID}
            return {"kind": "done", "content": pickle.dumps(run(spec))}
    except BaseException as error:  # noqa: BLE001  raised again by the engine
        return {"kind": "raised", "content": pickled_exception(error)}


def actor_class() -> Any:
    """Return the class of the actors, which Ray sends to its workers by value.

    A worker can thus tell by itself that it lacks the project, or has another version of it.
    """
    import ray

    class Actor:
        def hello(self) -> dict[str, Any]:
            import ray

            context = ray.get_runtime_context()
            where = {"node": context.get_node_id(), "address": ray.util.get_node_ip_address()}
            try:
                from experiments.run.ray_worker import Host, about

                self.host = Host()
                return {**where, **about()}
            except Exception as error:  # noqa: BLE001  anything can be wrong with an installation
                return {**where, "missing": f"{type(error).__name__}: {error}"}

        def run(self, order: dict[str, Any], files: dict[str, Any], content: Any) -> Any:
            import ray

            lacking = self.host.lacks(order["files"])
            given = {name: ray.get(files[name]) for name in lacking if name in files}
            return self.host.take(order, given, content)

        def changes(self, folder: str, known: dict[str, str]) -> Any:
            return self.host.changes(folder, known)

        def end(self) -> None:
            self.host.end()

        def close(self) -> None:
            self.host.close()

    return ray.remote(num_cpus=1, max_concurrency=2, max_restarts=0, max_task_retries=0)(Actor)
