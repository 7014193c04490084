"""Write the lists of packages with hashes that `make setup` installs: `make lock`.

Versions are those of constraints.txt. For each set-up, `uv` finds all packages it needs on any
platform, and the hashes of all their files that the package index serves. The packages with which
torch brings CUDA are left out: they are gigabytes that nothing here uses. Builds of torch for the
CPU alone, in the folders of PIP_FIND_LINKS, get a list of their own, which is tried first; where
there is none, the set-up adds the packages for CUDA afterwards.
"""

import hashlib
import os
import re
import subprocess
import sys
from pathlib import Path

HERE = Path(__file__).parent
EXTRAS: dict[str, tuple[str, ...]] = {"run": ("plants",), "dev": ("test", "dev"), "docs": ("docs",)}
"""Extras of pyproject.toml in each list."""
CUDA = re.compile(r"(nvidia|cuda|triton)\b")


def compiled(extras: tuple[str, ...]) -> str:
    """Return the list of a set-up as uv writes it."""
    chosen = [word for extra in extras for word in ("--extra", extra)]
    uv = Path(sys.executable).with_name("uv")
    done = subprocess.run(  # noqa: S603  words of this file
        [uv, "pip", "compile", "pyproject.toml", "requirements/build.in", *chosen,
         "--universal", "--python-version", "3.11", "--constraint", "constraints.txt",
         "--generate-hashes", "--no-header", "--no-annotate", "--quiet"],
        cwd=HERE.parent, check=True, capture_output=True, text=True,
    )  # fmt: skip
    return done.stdout


def without_cuda(text: str) -> str:
    """Return a list without the packages of CUDA."""
    entries = re.split(r"\n(?=\S)", text.strip())
    return "\n".join(entry for entry in entries if not CUDA.match(entry)) + "\n"


def torch_for_cpu() -> str:
    """Return the list of torch's builds for the CPU in the folders of PIP_FIND_LINKS."""
    pin = re.search(r"^torch==(\S+)", (HERE.parent / "constraints.txt").read_text(), re.MULTILINE)
    assert pin is not None
    hashes = [
        f"    --hash=sha256:{hashlib.sha256(file.read_bytes()).hexdigest()}"
        for folder in os.environ.get("PIP_FIND_LINKS", "").split()
        for file in sorted(Path(folder).glob(f"torch-{pin[1]}+cpu-*.whl"))
    ]
    return " \\\n".join([f"torch=={pin[1]}+cpu", *hashes]) + "\n"


def main() -> int:
    """Write all lists."""
    for name, extras in EXTRAS.items():
        (HERE / f"{name}.txt").write_text(without_cuda(compiled(extras)), encoding="utf-8")
    (HERE / "torch-cpu.txt").write_text(torch_for_cpu(), encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
