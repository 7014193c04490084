"""Runs for the engines' tests that load no numerical library, and clusters of this computer."""

import os
import signal
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

Spec = Mapping[str, Any]
STORE = 80_000_000
"""Memory for objects of a node, bytes."""


@contextmanager
def cluster(nodes: int = 2, **more: str) -> Iterator[Any]:
    """A Ray cluster of nodes with one CPU each; `more` are environment variables of the nodes."""
    from experiments.run.ray_session import LOOPBACK, QUIET

    os.environ.update(QUIET | LOOPBACK)
    from ray.cluster_utils import Cluster

    head = {"include_dashboard": False, "include_log_monitor": False}
    made = Cluster(initialize_head=True, head_node_args={**head, **node(1, **more)})
    try:
        for _ in range(nodes - 1):
            made.add_node(**node(1, **more))
        yield made
    finally:
        made.shutdown()


def node(cpus: int, **more: str) -> dict[str, Any]:
    """Arguments of a node of a cluster; `more` are environment variables."""
    # Ray's workers do not know where pytest found the functions of tests.
    variables = {"PYTHONPATH": str(Path(__file__).parents[2]), **more}
    return {"num_cpus": cpus, "object_store_memory": STORE, "env_vars": variables}


def kill_node(one: Any) -> None:
    """Kill a node of a cluster of this process with -9, and all that runs on it."""
    (process,) = (each.process for each in one.all_processes["raylet"])
    below = descendants(process.pid)
    process.kill()
    process.wait()
    for pid in below:
        try:
            os.kill(pid, signal.SIGKILL)
        except ProcessLookupError:
            continue


def descendants(pid: int) -> list[int]:
    """Processes below a process."""
    parents = {}
    for entry in Path("/proc").glob("[0-9]*/stat"):
        try:
            fields = entry.read_text().rpartition(")")[2].split()
        except OSError:
            continue
        if fields[0] != "Z":
            parents[int(entry.parent.name)] = int(fields[1])
    found, now = [], [pid]
    while now:
        now = [child for child, parent in parents.items() if parent in now]
        found += now
    return found


def children_at_work(pid: int) -> list[int]:
    """Processes that drive cases below a process."""
    found = []
    for one in descendants(pid):
        try:
            command = Path(f"/proc/{one}/cmdline").read_bytes()
        except OSError:
            continue
        if b"spawn_main" in command:
            found.append(one)
    return found


def note(spec: Spec) -> dict[str, Any]:
    """Say which processes ran the spec, and in which folder."""
    time.sleep(spec.get("lasts", 0.0))
    processes = {"pid": os.getpid(), "actor": os.getppid()}
    return {"seed": spec["seed"], "status": "ok", "where": str(Path.cwd()), **processes}


def failed(spec: Spec, error: str) -> dict[str, Any]:
    """Result of a spec that failed."""
    return {"seed": spec["seed"], "status": "failed", "error": error}


def misbehave(spec: Spec) -> dict[str, Any]:
    """Die, take too long, or raise, as the spec asks."""
    if spec.get("does") == "die":
        os._exit(9)
    if spec.get("does") == "last":
        time.sleep(600)
    if spec.get("does") == "die once" and not Path(spec["mark"]).exists():
        Path(spec["mark"]).touch()
        os._exit(9)
    if spec.get("does") == "kill the actor":
        os.kill(os.getppid(), signal.SIGKILL)
        time.sleep(600)
    if spec.get("does") == "raise":
        raise ArithmeticError("no such luck")
    return note(spec)


def work_in_folder(spec: Spec) -> dict[str, Any]:
    """Count runs in the folder, as a training that goes on; remove a file, and raise if asked."""
    folder = Path(spec["folder"])
    (folder / "inner").mkdir(exist_ok=True, parents=True)
    count = folder / "inner" / "count.txt"
    count.write_text(str(int(count.read_text()) + 1 if count.exists() else 1))
    (folder / "old.txt").unlink(missing_ok=True)
    if spec.get("raises"):
        raise ArithmeticError("no such luck")
    time.sleep(spec.get("lasts", 0.0))
    return {"where": str(folder.resolve())}


def seed_and_folder(spec: Spec) -> str:
    """Identity that is another wherever the working directory is."""
    return f"{spec['seed']} {Path.cwd()}"
