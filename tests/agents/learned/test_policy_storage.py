"""The two files of a policy are exchanged together, whatever happens on the way."""

import itertools
import os
import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from agents.base import CHECKPOINTS
from agents.learned import files, storage
from agents.learned.storage import remove_files
from agents.weight_tuning.policy import WeightPolicy, load
from agents.weights import WeightSchedule
from tests.helpers.policy_files import DRIVING, PolicyKind, beside, each_kind

CALLS = (("replace", Path), ("unlink", Path), ("mkdir", Path), ("fsync", os), ("open", Path))
"""Everything by which a writer changes files."""
DIED = 9


def dies_at(count: int, after: bool, action: Callable[[], object]) -> int:
    """Do something in a child process that dies before or after its change `count` of files."""
    child = os.fork()
    if child:
        return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    numbers = itertools.count()
    for name, owner in CALLS:
        plain = getattr(owner, name)

        def dying(*given: Any, plain: Any = plain, **named: Any) -> Any:
            now = next(numbers) == count
            if now and not after:
                os._exit(DIED)
            done = plain(*given, **named)
            if now:
                os._exit(DIED)
            return done

        setattr(owner, name, dying)
    action()
    os._exit(0)


def as_before(kind: PolicyKind, file: Path, policy: Any) -> None:
    """Write a policy as earlier versions did, with its weights in NAME.safetensors."""
    kind.write(policy, file)
    spec = files.read_spec(kind.kind, file)
    weights = beside(file).replace(file.with_suffix(".safetensors"))
    spec["weights"]["file"] = weights.name
    spec["digest"] = files.digest_of(spec)
    file.write_text(files.json.dumps(spec))


@each_kind
@pytest.mark.parametrize("before", ["none", "earlier version", "this version"])
@pytest.mark.parametrize("after", [False, True])
def test_a_crash_at_any_moment_leaves_the_old_or_the_new_policy(
    kind: PolicyKind, before: str, after: bool, tmp_path: Path
) -> None:
    old, new, last = (kind.make(seed=seed, hidden=(3,)) for seed in (0, 1, 2))
    found = []
    for count in itertools.count():
        folder = tmp_path / str(count)
        folder.mkdir()
        file = folder / "mine.json"
        if before == "earlier version":
            as_before(kind, file, old)
        elif before == "this version":
            kind.write(old, file)
        code = dies_at(count, after, lambda file=file: kind.write(new, file))  # type: ignore[misc]
        if before == "none" and not file.exists():
            found.append("none")
        else:
            policy = kind.read(file)
            found.append("new" if kind.same(policy, new) else "old")
            assert found[-1] == "new" or kind.same(policy, old)
        # Whatever the crash has left is gone after the next policy.
        kind.write(last, file)
        assert kind.same(kind.read(file), last)
        assert {*folder.iterdir()} == {file, beside(file)}
        if code == 0:
            break
        assert code == DIED
    assert found == sorted(found, key=["none", "old", "new"].index)
    assert found[0] == ("none" if before == "none" else "old")
    assert found[-1] == "new"
    assert len(found) > 8


WRITER = """
import sys
from pathlib import Path
from tests.helpers.policy_files import KINDS
kind = KINDS[int(sys.argv[2])]
# Two of the three have the same weights, so that their weights' files have the same name.
policies = [kind.make(seed=seed // 2, hidden=(3,), training={"seed": seed}) for seed in range(3)]
for k in range(60):
    kind.write(policies[(k + int(sys.argv[3])) % 3], Path(sys.argv[1]))
"""


@pytest.mark.parametrize("number", [0, 1])
def test_readers_and_writers_at_the_same_time(number: int, tmp_path: Path) -> None:
    from tests.helpers.policy_files import KINDS

    kind, file = KINDS[number], tmp_path / "mine.json"
    kind.write(kind.make(hidden=(3,), training={"seed": 0}), file)
    writers = [
        subprocess.Popen([sys.executable, "-c", WRITER, str(file), str(number), str(k)])
        for k in range(3)
    ]
    read = 0
    try:
        while any(writer.poll() is None for writer in writers):
            for reader in kind.readers:
                assert reader(file).training["seed"] in range(3)
                read += 1
        assert [writer.wait(60) for writer in writers] == [0, 0, 0]
    finally:
        for writer in writers:
            writer.kill()
            writer.wait()
    kind.read(file)
    assert {*tmp_path.iterdir()} == {file, beside(file)}
    assert read > 10


@each_kind
def test_nothing_else_is_removed(kind: PolicyKind, tmp_path: Path) -> None:
    others = [
        "mine.json.bak", "mine.txt", "mine2.safetensors", "other.0123456789abcdef.safetensors",
        "mine.0123456789abcde.safetensors", "mine.0123456789ABCDEF.safetensors", ".mine.tmp",
        "xmine.0123456789abcdef.safetensors", ".other.json.0123abcd.tmp",
    ]  # fmt: skip
    for name in others:
        (tmp_path / name).write_text("")
    file = kind.written(tmp_path)
    kind.write(kind.make(seed=1), file)
    assert {found.name for found in tmp_path.iterdir()} == {*others, file.name, beside(file).name}
    remove_files(file)
    assert {found.name for found in tmp_path.iterdir()} == {*others}
    remove_files(file)


@each_kind
def test_without_a_lock_nothing_is_removed(
    kind: PolicyKind, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = kind.written(tmp_path)
    first = beside(file)
    monkeypatch.setattr(storage, "fcntl", None)
    kind.write(kind.make(seed=1), file)
    assert {*tmp_path.iterdir()} == {file, first, beside(file)}
    assert kind.same(kind.read(file), kind.make(seed=1))


@each_kind
def test_a_stopped_writer_is_not_waited_for_longer_than_said(
    kind: PolicyKind, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    fcntl = pytest.importorskip("fcntl", reason="this system has no such locks")
    monkeypatch.setattr(storage, "PATIENCE", 0.05)
    handle = os.open(tmp_path, os.O_RDONLY)
    fcntl.flock(handle, fcntl.LOCK_EX)
    try:
        file = kind.written(tmp_path)
    finally:
        os.close(handle)
    kind.read(file)


def test_the_shipped_policies_have_weights_of_their_names_and_are_read() -> None:
    for name in ("ppo", "sac", "bc"):
        assert beside(CHECKPOINTS / f"{name}.json").name.split(".")[0] == name
        assert DRIVING.read(CHECKPOINTS / f"{name}.json").algorithm == name
    paired = CHECKPOINTS / "lpv-nmpc-tuned-paired.json"
    assert beside(paired).name.split(".")[0] == paired.stem
    assert isinstance(load(paired), WeightPolicy)
    assert isinstance(load(CHECKPOINTS / "lpv-nmpc-tuned.json"), WeightSchedule)


@each_kind
def test_weights_alone_name_the_spec_to_give(kind: PolicyKind, tmp_path: Path) -> None:
    weights = beside(kind.written(tmp_path))
    with pytest.raises(ValueError, match=re.escape(f"give its spec, {tmp_path / 'mine.json'}")):
        kind.read(weights)
