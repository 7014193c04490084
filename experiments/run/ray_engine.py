"""Engine that runs specs over the computers of a Ray cluster.

Each CPU has an actor, whose child process runs one spec after another, as a local worker does. An
actor has one spec at a time, so that a sweep of any length holds few objects. The spec of a lost
actor runs again elsewhere. Nothing is left on a cluster but Ray itself.
"""

import contextlib
import math
import pickle
import secrets
import time
import warnings
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from experiments.run import shipping
from experiments.run.provenance import COMPUTING
from experiments.run.ray_session import connected
from experiments.run.ray_worker import CHILD_DIED, OTHER_ID, about, actor_class, packed
from experiments.run.worker_process import (
    DIED,
    PATIENCE,
    Failed,
    Files,
    Folder,
    Identity,
    Machine,
    Result,
    Run,
    Spec,
)
from trajectories.arguments import shortened

TURN = 1.0
"""Time between looks at the nodes, s."""
MOST_LOSSES = 5
"""Losses of its actor after which a spec has failed."""
MOST_STARTING = 60.0
"""Time since the last hello after which a sweep without actors ends if none can start, s."""
SAID = 20.0
"""Time without any actor after which the user is told, s."""
LOST = f"the worker that ran it was lost, {MOST_LOSSES} times"
COPIED = 60.0
"""Time between copies of the folder of a run that lasts, s."""
RETURNED = 30.0
"""Longest wait for the folders of interrupted runs, s."""


def run_on_ray(
    specs: Sequence[Spec],
    workers: int | None,
    address: str | None,
    run: Run,
    failed: Failed,
    *,
    started: Callable[[Spec], None] | None,
    limit: float,
    files: Files | None,
    folder: Folder | None,
    identity: Identity | None,
    machine: Machine | None,
) -> Iterator[Result]:
    """Run specs on a Ray cluster and yield results as they end; see `Engine.run` of `engines`.

    Raises
    ------
    ModuleNotFoundError
        If Ray is not installed.
    ValueError
        If the cluster cannot be reached, or all of its nodes refuse the specs.
    """
    with connected(workers, address):
        task = _Task(run, failed, limit, files, folder, identity, machine)
        sweep = _Sweep(specs, workers, task, started or (lambda _: None))
        try:
            while sweep.unfinished:
                yield from sweep.turn()
        finally:
            sweep.end()


@dataclass(frozen=True)
class _Task:
    """All that the specs of a sweep have in common."""

    run: Run
    failed: Failed
    limit: float
    files: Files | None
    folder: Folder | None
    identity: Identity | None
    machine: Machine | None


@dataclass(eq=False)
class _Actor:
    """An actor and its state: it says hello, is idle, or runs the spec of a number."""

    handle: Any
    at: Any
    """Reference to the answer that it owes; None if it is idle."""
    node: str | None = None
    address: str = ""
    number: int | None = None
    """Place of its spec in the sweep."""
    versions: Mapping[str, str] = field(default_factory=dict)
    folder: Path | None = None
    """Folder of the spec, which travels there and back."""
    known: dict[str, str] = field(default_factory=dict)
    """Digests of those of the folder's files that have travelled."""
    copy: Any = None
    """Reference to changes in the folder."""
    copied: float = 0.0
    """Time at which they were last asked for, s."""
    token: Path | None = None
    """File by which the actor sees that it has the folder itself."""


class _Sweep:
    """Specs of a sweep, and the actors that run them."""

    def __init__(
        self,
        specs: Sequence[Spec],
        workers: int | None,
        task: _Task,
        started: Callable[[Spec], None],
    ) -> None:
        import ray

        self._ray, self._class = ray, actor_class()
        self._specs, self._most, self._task, self._started = specs, workers, task, started
        self._fresh = list(reversed(range(len(specs))))
        self._suspects: list[int] = []
        """Specs that run alone on a computer: one of them may bring a worker down."""
        self._deaths: Counter[int] = Counter()
        self._losses: Counter[int] = Counter()
        self._actors: list[_Actor] = []
        self._again: set[int] = set()
        """Specs that have started before, and wait again."""
        self._refused: dict[str, str] = {}
        self._looked, self._greeted = -math.inf, time.monotonic()
        self._said = False
        self._call = packed(task.run, task.identity)
        self._here = about()
        self._machines = {self._here["key"]}
        self._objects: dict[str, Any] = {}
        """Contents of files on the cluster, by digest."""

    @property
    def _busy(self) -> list[_Actor]:
        return [actor for actor in self._actors if actor.number is not None]

    @property
    def unfinished(self) -> bool:
        """True while a spec waits or runs."""
        return bool(self._fresh or self._suspects or self._busy)

    def turn(self) -> list[Result]:
        """Recruit actors, give them specs, and return the results that there are."""
        if time.monotonic() - self._looked > TURN:
            self._recruit()
            self._copy_folders()
            self._say_waiting()
            self._looked = time.monotonic()
        self._assign()
        waiting = {actor.at: actor for actor in self._actors if actor.at is not None}
        copies = {actor.copy: actor for actor in self._actors if actor.copy is not None}
        everything = [*copies, *waiting]
        if not everything:
            time.sleep(TURN)
            return []
        self._ray.wait(everything, num_returns=1, timeout=TURN)
        ready, _ = self._ray.wait(everything, num_returns=len(everything), timeout=0)
        results: list[Result] = []
        for reference in sorted(ready, key=everything.index):
            if reference in copies:
                self._take_copy(copies[reference])
            else:
                results += self._hear(waiting[reference])
        # The caller may take long over the results: actors are not to be idle meanwhile.
        self._assign()
        return results

    # Actors ---------------------------------------------------------------------------------------

    def _recruit(self) -> None:
        """Ask for as many actors as can be used, on nodes that have not refused."""
        nodes = {one["NodeID"]: one for one in self._ray.nodes() if one["Alive"]}
        good = [one for key, one in nodes.items() if key not in self._refused]
        if not good and self._refused:
            raise ValueError(
                f"no node of the Ray cluster can be used: {[*self._refused.values()][-1]}"
            )
        cpus = int(sum(one["Resources"].get("CPU", 0) for one in good))
        waiting = len(self._fresh) + len(self._suspects) + len(self._busy)
        options: dict[str, Any] = {"scheduling_strategy": "SPREAD"}
        if self._refused:
            options["label_selector"] = {"ray.io/node-id": f"!in({','.join(self._refused)})"}
        while len(self._actors) < min(self._most or cpus, waiting):
            handle = self._class.options(**options).remote()
            self._actors.append(_Actor(handle, handle.hello.remote()))

    def _say_waiting(self) -> None:
        """Say once that nothing runs for want of a free CPU."""
        late = time.monotonic() - self._greeted > SAID
        if late and not self._said and not any(one.node for one in self._actors):
            self._said = True
            warnings.warn("waiting for a free CPU of the Ray cluster", UserWarning, stacklevel=2)

    def _drop(self, actor: _Actor) -> None:
        self._actors.remove(actor)
        self._ray.kill(actor.handle)

    def _refuse(self, actor: _Actor, reason: str) -> None:
        """Stop using the node of an actor, and say so."""
        assert actor.node is not None
        line = f"node {actor.address} refuses: {reason}"
        if actor.node not in self._refused:
            warnings.warn(line, UserWarning, stacklevel=2)
        self._refused[actor.node] = line
        # The node's other actors end what they have accepted, or refuse likewise.
        self._drop(actor)

    def _greet(self, actor: _Actor, there: Mapping[str, Any]) -> None:
        """Accept an actor that has said hello, if it computes the same."""
        actor.node, actor.address, actor.at = there["node"], there["address"], None
        actor.versions = there.get("versions", {})
        self._greeted = time.monotonic()
        if actor.node in self._refused:
            self._drop(actor)
        elif reason := self._difference(there):
            self._refuse(actor, reason)
        elif there["key"] not in self._machines:
            self._machines.add(there["key"])
            if self._task.machine is not None:
                self._task.machine({"key": there["key"], **there["provenance"]})

    def _difference(self, there: Mapping[str, Any]) -> str | None:
        """Return why a worker does not compute the same; None if it does."""
        if "missing" in there:
            return f"lpv-track-env cannot be loaded there ({shortened(there['missing'], 120)})"
        here, own = self._here["sources"], there["sources"]
        if here != own:
            return (
                f"other sources (digest {own} there, {here} here): install the same version of "
                "lpv-track-env there"
            )
        # The versions of optional packages are part of the ids of cases that use them.
        optional = self._task.identity is None
        changed = self._changed(there["versions"], None if optional else COMPUTING)
        return f"other versions ({changed}): install the same there" if changed else None

    def _changed(self, there: Mapping[str, str], only: Sequence[str] | None = None) -> str:
        """Return the first versions that differ, in words; "" if there are none."""
        here = self._here["versions"]
        names = {*here, *there} if only is None else {"python", "machine", *only}
        return "; ".join(
            f"{name} {there.get(name, 'missing')} there, {here.get(name, 'missing')} here"
            for name in sorted(names)
            if here.get(name) != there.get(name)
        )[:150]

    # Specs ----------------------------------------------------------------------------------------

    def _assign(self) -> None:
        """Give specs to idle actors."""
        for actor in [one for one in self._actors if one.at is None]:
            if actor.node in self._refused:
                self._drop(actor)
            elif self._fresh:
                self._give(actor, self._fresh.pop())
            elif self._suspects and actor.node not in {one.node for one in self._busy}:
                self._give(actor, self._suspects.pop())

    def _give(self, actor: _Actor, number: int) -> None:
        spec, task = self._specs[number], self._task
        order: dict[str, Any] = {
            "call": self._call,
            "spec": pickle.dumps(spec),
            "id": None if task.identity is None else task.identity(spec),
            "limit": task.limit,
        }
        named = () if task.files is None else shipping.with_weights(task.files(spec))
        found = shipping.contents(named)
        order["files"] = shipping.digests(found)
        given = {
            name: self._object(order["files"][name], content)
            for name, content in found.items()
            if not Path(name).is_absolute()
        }
        folder = None if task.folder is None else task.folder(spec)
        content, actor.folder = None, None
        if folder is not None and folder.is_absolute():
            actor.token = folder / f".here.{secrets.token_hex(4)}.tmp"
            folder.mkdir(parents=True, exist_ok=True)
            actor.token.touch()
            order["token"] = str(actor.token)
        elif folder is not None:
            content = dict(shipping.changes(folder, {}).files)
            actor.folder, actor.known = folder, shipping.digests(content)
            actor.copied = time.monotonic()
            order["folder"], order["known"] = str(folder), actor.known
        actor.number, actor.at = number, actor.handle.run.remote(order, given, content)
        if number in self._again:
            self._again.remove(number)
        else:
            self._started(spec)

    def _object(self, digest: str, content: bytes) -> Any:
        if digest not in self._objects:
            self._objects[digest] = self._ray.put(content)
        return self._objects[digest]

    def _hear(self, actor: _Actor) -> list[Result]:
        """Take what an actor answers; return the result, if that is one."""
        try:
            answer = self._ray.get(actor.at)
        except self._ray.exceptions.RayTaskError as error:
            answer = {
                "kind": "refused",
                "content": f"{type(error.cause).__name__}: {shortened(error.cause)}",
            }
        except self._ray.exceptions.RayError as error:
            return self._lose(actor, shortened(error))
        if actor.number is None:
            self._greet(actor, answer)
            return []
        number = self._finish(actor)
        if answer["kind"] == "refused":
            self._wait_again(number, self._fresh)
            reason = answer["content"]
            if reason == OTHER_ID:
                reason += f" ({self._changed(actor.versions) or 'a module of its own differs'})"
            self._refuse(actor, reason)
            return []
        if "changes" in answer:
            self._apply(actor, answer["changes"])
        return self._result(number, answer)

    def _wait_again(self, number: int, among: list[int]) -> None:
        among.append(number)
        self._again.add(number)

    def _finish(self, actor: _Actor) -> int:
        """Take the spec from an actor, and return its number."""
        assert actor.number is not None
        number, actor.number, actor.at, actor.copy = actor.number, None, None, None
        if actor.token is not None:
            actor.token.unlink(missing_ok=True)
            actor.token = None
        return number

    def _result(self, number: int, answer: Mapping[str, Any]) -> list[Result]:
        spec, failed = self._specs[number], self._task.failed
        if answer["kind"] == "raised":
            raise pickle.loads(answer["content"])[1]  # noqa: S301  from a worker of our own
        if answer["kind"] == "failed":
            return [failed(spec, answer["content"])]
        if answer["kind"] == CHILD_DIED:
            self._deaths[number] += 1
            if self._deaths[number] > 1:
                return [failed(spec, DIED)]
            self._wait_again(number, self._suspects)
            return []
        return [pickle.loads(answer["content"])]  # noqa: S301  from a worker of our own

    def _lose(self, actor: _Actor, reason: str) -> list[Result]:
        """Forget an actor that was lost; its spec runs again elsewhere."""
        self._actors.remove(actor)
        if actor.number is None:
            lately = time.monotonic() - self._greeted < MOST_STARTING
            if not lately and not any(one.node for one in self._actors):
                raise ValueError(f"Ray cannot start workers: {reason}")
            return []
        number = self._finish(actor)
        self._losses[number] += 1
        if self._losses[number] == MOST_LOSSES:
            return [self._task.failed(self._specs[number], LOST)]
        self._wait_again(number, self._fresh if self._losses[number] == 1 else self._suspects)
        return []

    # Folders --------------------------------------------------------------------------------------

    def _copy_folders(self) -> None:
        """Ask for the folders of runs that last, so that not all is lost with an actor."""
        now = time.monotonic()
        for actor in self._busy:
            if actor.folder is not None and actor.copy is None and now - actor.copied > COPIED:
                actor.copied = now
                actor.copy = actor.handle.changes.remote(str(actor.folder), actor.known)

    def _take_copy(self, actor: _Actor) -> None:
        reference, actor.copy = actor.copy, None
        # An actor that was lost is noticed by what it runs.
        with contextlib.suppress(self._ray.exceptions.RayError):
            self._apply(actor, self._ray.get(reference))

    def _apply(self, actor: _Actor, changed: shipping.Changes) -> None:
        assert actor.folder is not None
        actor.known = shipping.apply(actor.folder, changed, actor.known)

    def end(self) -> None:
        """End all actors; folders of interrupted runs are brought back before."""
        away = [actor for actor in self._busy if actor.folder is not None]
        for actor in away:
            actor.handle.end.remote()
        if away:
            self._ray.wait([actor.at for actor in away], num_returns=len(away), timeout=RETURNED)
        for actor in away:
            with contextlib.suppress(self._ray.exceptions.RayError):
                answer = self._ray.get(actor.at, timeout=0)
                if "changes" in answer:
                    self._apply(actor, answer["changes"])
        for actor in self._busy:
            self._finish(actor)
        closed = [actor.handle.close.remote() for actor in self._actors if actor.node is not None]
        if closed:
            self._ray.wait(closed, num_returns=len(closed), timeout=PATIENCE)
        for actor in [*self._actors]:
            self._drop(actor)
