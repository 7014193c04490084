"""Connection to a Ray cluster, or to a Ray that is started on this computer."""

import contextlib
import logging
import os
import socket
from collections.abc import Iterator
from typing import Any

from experiments.run.worker_process import PATIENCE
from trajectories.arguments import shortened, shown

QUIET = {
    "RAY_USAGE_STATS_ENABLED": "0",
    "RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO": "0",
    # Matches all that Ray prints about other processes, such as the log of a node that was lost.
    "RAY_DEDUP_LOGS_SKIP_REGEX": ".",
}
"""Environment that keeps Ray's own messages off the screen, and GPUs visible."""
LOOPBACK = {"RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER": "0"}
"""Environment of a Ray that only this computer reaches; else Ray takes 127.0.0.1 for another."""
OWN = ("127.0.0.1", "localhost", "[::1]")
"""Names of this computer in an address."""
STORE = 2**29
"""Memory for objects of a local Ray, bytes; more goes to disk."""


@contextlib.contextmanager
def connected(workers: int | None, address: str | None) -> Iterator[None]:
    """Connect to a cluster, or start a Ray on this computer, which ends with the context.

    If this process is connected to a Ray already, that one is used.

    Parameters
    ----------
    workers
        Number of CPUs of a Ray on this computer; None: all.
    address
        Address of the cluster; None: a Ray on this computer.

    Raises
    ------
    ModuleNotFoundError
        If Ray is not installed.
    ValueError
        If there is no Ray at the address, or none can be started.
    """
    own = address is None or address.rpartition(":")[0] in OWN
    wanted = QUIET | LOOPBACK if own else QUIET
    os.environ.update({key: value for key, value in wanted.items() if key not in os.environ})
    try:
        import ray
    except ModuleNotFoundError:
        raise ModuleNotFoundError(
            "--engine ray needs ray: pip install 'lpv-track-env[ray]'"
        ) from None
    if ray.is_initialized():
        yield
        return
    options: dict[str, Any] = {"log_to_driver": False, "logging_level": logging.CRITICAL}
    if address is None:
        options |= {
            "address": "local", "num_cpus": workers or os.cpu_count() or 1,
            "include_dashboard": False, "object_store_memory": STORE,
        }  # fmt: skip
    try:
        if address is not None:
            _reach(address)
            options["address"] = address
        ray.init(**options)
    except (OSError, RuntimeError, ValueError) as error:
        where = "on this computer" if address is None else f"at {shown(address)}"
        raise ValueError(
            f"no Ray {where} ({shortened(error, 120)}): on a cluster run ray start --head, and "
            "this command on one of its computers, see docs/benchmark.md"
        ) from None
    try:
        yield
    finally:
        ray.shutdown()


def _reach(address: str) -> None:
    """Check that something listens at an address, for which Ray itself would wait for minutes.

    Raises
    ------
    OSError
        If nothing does.
    ValueError
        If it is neither HOST:PORT nor "auto".
    """
    host, _, port = address.rpartition(":")
    if address != "auto":
        if not host or not port.isdecimal():
            raise ValueError("give HOST:PORT, as ray start prints it, or auto")
        socket.create_connection((host, int(port)), timeout=PATIENCE).close()
