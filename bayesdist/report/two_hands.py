"""The figures of a report drawn by two processes, where there are many and two processors.

The other process is a program of its own, not a fork: threads of numerical libraries run here.  It
makes and draws every second figure; should it fail, they are drawn here.
"""

from __future__ import annotations

import logging
import os
import pickle
import subprocess
import sys
import tempfile
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path

from bayesdist.report.context import ReportInput
from bayesdist.report.drawing import Drawing, pdf_of, png_of
from bayesdist.report.figures import plan_of_figures

__all__ = ["drawn_report"]

log = logging.getLogger("bayesdist")

MANY = 24  # figures: fewer are drawn sooner than another process has started


def drawn_report(inputs: ReportInput) -> dict[str, Drawing]:
    """All figures of a report as files, in its order; the same whoever draws them.

    Parameters
    ----------
    inputs : ReportInput

    Returns
    -------
    dict of str to Drawing
    """
    names = list(plan_of_figures(inputs))
    if len(names) < MANY or (os.cpu_count() or 1) < 2 or not sys.executable:
        return _drawings(inputs, names)
    found: dict[str, Drawing] = {}
    try:
        with _helper(inputs, names[1::2]) as helper:
            found = _drawings(inputs, names[::2])
            answer, _ = helper.communicate()
        if helper.returncode:
            raise OSError(f"it ended with exit code {helper.returncode}")
        found |= pickle.loads(answer)
    except (OSError, EOFError, pickle.PickleError, AttributeError, TypeError) as error:
        log.warning("report: figures are drawn by one process, the other failed: %s", error)
    found |= _drawings(inputs, [name for name in names if name not in found])
    return {name: found[name] for name in names}


def _drawings(inputs: ReportInput, names: Iterable[str]) -> dict[str, Drawing]:
    plan, out = plan_of_figures(inputs), {}
    for name in names:
        figure = plan[name]()
        out[name] = Drawing(png_of(figure), pdf_of(figure))
    return out


@contextmanager
def _helper(inputs: ReportInput, names: list[str]) -> Iterator[subprocess.Popen[bytes]]:
    """Another process that draws; it answers on its standard output."""
    code = "from bayesdist.report.two_hands import _answer; _answer()"
    with tempfile.TemporaryDirectory() as folder:  # of this user alone
        question = Path(folder) / "inputs"
        question.write_bytes(pickle.dumps((inputs, names)))
        helper = subprocess.Popen(
            [sys.executable, "-P", "-c", code, str(question)],
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            env=os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))},
        )
        with helper:
            try:
                yield helper
            finally:
                helper.kill()


def _answer() -> None:
    inputs, names = pickle.loads(Path(sys.argv[1]).read_bytes())
    sys.stdout.buffer.write(pickle.dumps(_drawings(inputs, names)))
