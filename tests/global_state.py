"""State of a process that does not belong to bayesdist, before and after the package is used.

`python -m tests.global_state libraries` prints the modules of other packages that all modules of
bayesdist import.  `python -m tests.global_state changes` reads such a list from its standard input,
imports these first, and prints what importing and using bayesdist changes after that.
"""

from __future__ import annotations

import gc
import importlib
import json
import locale
import logging
import multiprocessing
import os
import pkgutil
import random
import signal
import sys
import threading
import warnings
from contextlib import suppress
from pathlib import Path
from typing import Any

PACKAGE = "bayesdist"


def modules() -> list[str]:
    """Names of all modules of the package."""
    package = importlib.import_module(PACKAGE)
    found = pkgutil.walk_packages(package.__path__, f"{PACKAGE}.")
    return sorted(module.name for module in found)


def libraries() -> list[str]:
    """Names of the modules of other packages that are loaded with all modules of the package."""
    for name in modules():
        importlib.import_module(name)
    mine = (PACKAGE, "tests", "__main__")
    names = [name for name in sys.modules if name.split(".")[0] not in mine]
    return [name for name in names if name.split(".")[0] not in sys.stdlib_module_names]


def snapshot() -> dict[str, Any]:
    """Text of each part of the state, by name."""
    import decimal

    import matplotlib
    import numba
    import numpy as np

    package, root = logging.getLogger(PACKAGE), logging.getLogger()
    settings = {name: getattr(numba.config, name) for name in dir(numba.config) if name.isupper()}
    state = {
        "environment": dict(os.environ),
        "working directory": Path.cwd(),
        "sys.path": sys.path,
        "numba.config": settings,
        "garbage collector": (gc.get_threshold(), gc.isenabled(), gc.get_freeze_count()),
        "matplotlib": (dict(matplotlib.rcParams), "matplotlib.pyplot" in sys.modules),
        "warnings": (warnings.filters, warnings.showwarning),
        "numpy errors": np.geterr(),
        "numpy printing": np.get_printoptions(),
        "random numbers": (random.getstate(), np.random.get_state()),  # noqa: NPY002  it is what is watched
        "locale": locale.setlocale(locale.LC_ALL),
        "root logger": (root.level, root.handlers, logging.root.manager.disable),
        "package's logger": (package.level, package.propagate, package.handlers),
        "hooks": (sys.excepthook, sys.displayhook, threading.excepthook, sys.unraisablehook),
        "signals": [signal.getsignal(number) for number in signal.valid_signals()],
        "recursion": sys.getrecursionlimit(),
        "decimal": decimal.getcontext(),
        "start of processes": multiprocessing.get_start_method(allow_none=True),
        "streams": (sys.stdin, sys.stdout, sys.stderr),
    }
    return {name: repr(part) for name, part in state.items()}


def use() -> None:
    """Call public functions: a linear fit, its posterior, and a map of its errors."""
    import numpy as np

    import bayesdist as bd

    rng = np.random.default_rng(1)
    x, y = rng.uniform(1, 1000, (2, 300))
    noise = rng.normal(0, 0.01, (2, 300))
    sigma = np.full(300, 0.01)
    matches = bd.Matches(
        x=x, y=y, u=x + noise[0], v=y + noise[1], sigma_u=sigma, sigma_v=sigma, unit="pix"
    )
    fit = bd.fit_linear(matches, bd.build_model(matches, order=2, size=(1000, 1000)))
    bd.uncertainty_map(bd.sample(fit, matches, seed=1))


def changes(first: list[str]) -> list[str]:
    """What differs after the package was imported and used, once `first` have been imported."""
    for name in first:
        with suppress(ImportError):  # made by another module while it is imported
            importlib.import_module(name)
    package = importlib.import_module(PACKAGE)
    before = snapshot()
    for name in modules():
        importlib.import_module(name)
    for name in package.__all__:
        getattr(package, name)
    imported = snapshot()
    use()
    used = snapshot()
    return [
        f"{name}, {when}: {before[name][:2000]} became {after[name][:2000]}"
        for when, after in (("imported", imported), ("used", used))
        for name in before
        if after[name] != before[name]
    ]


if __name__ == "__main__":
    if sys.argv[1] == "libraries":
        print(json.dumps(libraries()))
    else:
        print(json.dumps(changes(json.loads(sys.stdin.read()))))
