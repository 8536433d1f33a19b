"""`python -m tests.matrix [NAME ...]`: both commands of the README on each Python, old and new.

Each environment, such as 3.13-newest or 3.11-oldest, is a clone of the last commit with a `.venv`
of its own in build/matrix, in which `make demo` and `make test` run.  Interpreters are those on the
path, those of pyenv, and what uv finds or can install; one that is not to be had is skipped, and
said so.
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
MATRIX = ROOT / "build" / "matrix"
RESOLUTIONS = {"newest": "highest", "oldest": "lowest-direct"}  # as uv names them
NAMES = ("3.11-oldest", "3.11-newest", "3.12-newest", "3.13-newest", "3.14-newest")
COMMANDS = ("demo", "test")  # of the README
EXIT_FAILED, EXIT_USAGE = 1, 2


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the environments that are named, or all, and print one line for each."""
    parser = argparse.ArgumentParser(prog="python -m tests.matrix", description=__doc__)
    parser.add_argument("names", nargs="*", metavar="NAME", help=", ".join(NAMES))
    names = parser.parse_args(arguments).names or NAMES
    unknown = sorted(set(names) - set(NAMES))
    if unknown:
        print(f"no environment is named {', '.join(unknown)}; choose of {', '.join(NAMES)}")
        return EXIT_USAGE
    uv = _install_uv()
    results = {name: _run(name, uv) for name in names}
    print("\n".join(f"{name:12} {result}" for name, result in results.items()))
    return EXIT_FAILED if any("failed" in result for result in results.values()) else 0


def _install_uv() -> Path:
    """Path of uv, in an environment of its own."""
    folder = MATRIX / "uv"
    if not folder.exists():
        subprocess.run([sys.executable, "-m", "venv", folder], check=True)
        pip = _bin(folder) / "python", "-m", "pip", "install", "--quiet", "uv"
        subprocess.run(pip, check=True)
    return _bin(folder) / "uv"


def _bin(venv: Path) -> Path:
    """Folder of the programs of a virtual environment."""
    return venv / ("Scripts" if os.name == "nt" else "bin")


def find_python(version: str, uv: Path | None = None) -> Path | None:
    """Interpreter of a version such as "3.12"; None if there is none.

    Parameters
    ----------
    version : str
        Major and minor version.
    uv : Path, optional
        The program uv, which looks in further places and may download one.

    Returns
    -------
    Path or None
    """
    pyenv = Path(os.environ.get("PYENV_ROOT") or Path.home() / ".pyenv") / "versions"
    candidates = [
        shutil.which(f"python{version}"),
        *sorted(pyenv.glob(f"{version}.*/bin/python"), reverse=True),
    ]
    for candidate in filter(None, candidates):
        if _version(candidate) == version:
            return Path(candidate)
    if uv is not None:
        subprocess.run([uv, "python", "install", "--quiet", version], check=False)
        search = [uv, "python", "find", "--quiet", "--no-project", version]
        done = subprocess.run(search, capture_output=True, text=True, check=False)
        if done.returncode == 0:
            return Path(done.stdout.strip())
    return None


def _version(python: str | Path) -> str | None:
    """Major and minor version that an interpreter states; None if it does not run."""
    code = "import sys; print('%d.%d' % sys.version_info[:2])"
    try:
        done = subprocess.run([python, "-c", code], capture_output=True, text=True, check=False)
    except OSError:
        return None
    return done.stdout.strip() if done.returncode == 0 else None


def _run(name: str, uv: Path) -> str:
    """Result of an environment, in words."""
    version, _, age = name.partition("-")
    python = find_python(version, uv)
    if python is None:
        return f"skipped: no Python {version} was found"
    clone = MATRIX / name
    shutil.rmtree(clone, ignore_errors=True)
    subprocess.run(["git", "clone", "--quiet", ROOT, clone], check=True)
    venv = clone / ".venv"
    subprocess.run([python, "-m", "venv", venv], check=True)
    install = [uv, "pip", "install", "--quiet", "--python", _bin(venv) / "python"]
    install += ["--resolution", RESOLUTIONS[age], "--editable", ".[test]"]
    if subprocess.run(install, cwd=clone, check=False).returncode:
        return "failed: the dependencies cannot be installed"
    for stamp in (".installed", ".installed-test"):  # of the Makefile: nothing is left to install
        (venv / stamp).touch()
    environment = {k: v for k, v in os.environ.items() if k not in ("PYTHONPATH", "MAKEFLAGS")}
    for command in COMMANDS:
        start = time.perf_counter()
        done = subprocess.run(["make", command], cwd=clone, env=environment, check=False)
        if done.returncode:
            return f"failed: make {command} after {time.perf_counter() - start:.0f} s, in {clone}"
    return f"passed on {python}"


if __name__ == "__main__":
    sys.exit(main())
