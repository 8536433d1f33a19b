"""The figures of a report drawn by two processes, where there are many and two processors.

The other process is a program of its own, not a fork: threads of numerical libraries run here.  It
starts while results are still being read and draws what it is given, from the last figure on, as
this process does from the first; a figure is whose process claims it first.  Should the other one
fail, its figures are drawn here.
"""

from __future__ import annotations

import logging
import os
import pickle
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from bayesdist.report.context import ReportInput
from bayesdist.report.drawing import Drawing, drawing_of
from bayesdist.report.figures import plan_of_figures
from bayesdist.report.style import figure_style, new_figure

__all__ = ["Hand", "drawn_report", "second_hand"]

log = logging.getLogger("bayesdist")

Plan = Mapping[str, Callable[[], Figure]]


class Hand:
    """Another process that draws.

    Parameters
    ----------
    process : subprocess.Popen
    folder : path
        Where it finds what it is given, and both claim figures.
    """

    FAILURES = (
        *(OSError, EOFError, pickle.PickleError, AttributeError, TypeError, ValueError),
        *(ImportError, IndexError),
    )

    def __init__(self, process: subprocess.Popen[bytes], folder: Path) -> None:
        self.process, self.folder, self._given = process, folder, 0

    def give(self, plan: Callable[..., Plan], *arguments: Any) -> None:
        """Have it draw the figures of a plan: those that are nobody's yet."""
        path, pipe = self.folder / f"{self._given}.plan", self.process.stdin
        self._given += 1
        assert pipe is not None
        try:  # by a file: it may be drawing, and a full pipe would have this process wait
            path.write_bytes(pickle.dumps((plan, arguments)))
            pipe.write(f"{path}\n".encode())
            pipe.flush()
        except self.FAILURES as error:
            _failed(error)
            self.process.kill()

    def answer(self) -> dict[str, Drawing]:
        """What it has drawn; it ends with that."""
        pipe = self.process.stdout
        assert self.process.stdin is not None and pipe is not None
        try:
            with suppress(OSError):  # it may have left: its exit code says more
                self.process.stdin.close()
            answer = pipe.read()
            if self.process.wait():
                raise OSError(f"it ended with exit code {self.process.returncode}")
            found: dict[str, Drawing] = pickle.loads(answer)
        except self.FAILURES as error:
            _failed(error)
            return {}
        return found


def _failed(error: Exception) -> None:
    log.warning("report: figures are drawn by one process, the other failed: %s", error)


@contextmanager
def second_hand(wanted: bool) -> Iterator[Hand | None]:
    """Another process that will draw; it ends with the block.

    Parameters
    ----------
    wanted : bool
        Whether there are many figures: few are drawn sooner than a process has started.

    Yields
    ------
    Hand or None
        None where it is not wanted or cannot be had, and on one processor.
    """
    if not wanted or (os.cpu_count() or 1) < 2 or not sys.executable:
        yield None
        return
    with ExitStack() as stack:
        try:
            hand = stack.enter_context(_started())
        except OSError as error:
            _failed(error)
            hand = None
        yield hand


@contextmanager
def _started() -> Iterator[Hand]:
    code = "from bayesdist.report.two_hands import _draw; _draw()"
    with tempfile.TemporaryDirectory() as folder:  # of this user alone
        process = subprocess.Popen(
            [sys.executable, "-P", "-c", code, folder],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            env=os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))},
        )
        try:
            yield Hand(process, Path(folder))
        finally:
            process.kill()
            with suppress(OSError), process:  # of a pipe that it has left
                pass


def drawn_report(inputs: ReportInput, hand: Hand | None = None) -> dict[str, Drawing]:
    """All figures of a report as files, in its order; the same whoever draws them.

    Parameters
    ----------
    inputs : ReportInput
    hand : Hand, optional
        That may have begun with some of them.

    Returns
    -------
    dict of str to Drawing
    """
    plan, found = plan_of_figures(inputs), dict[str, Drawing]()
    if hand is not None:
        hand.give(plan_of_figures, inputs)
        found = _drawings(plan, plan, hand.folder)
        found |= hand.answer()
    found |= _drawings(plan, [name for name in plan if name not in found])
    return {name: found[name] for name in plan}


def _drawings(plan: Plan, names: Iterable[str], claims: Path | None = None) -> dict[str, Drawing]:
    return {
        name: drawing_of(plan[name]()) for name in names if claims is None or _claimed(claims, name)
    }


def _claimed(claims: Path, name: str) -> bool:
    """Whether a figure was nobody's; now it is of this process."""
    try:
        (claims / name).touch(exist_ok=False)
    except FileExistsError:
        return False
    except OSError:  # rather drawn twice than not at all
        pass
    return True


def _draw() -> None:
    """Draw what is given: the other process."""
    claims, found = Path(sys.argv[1]), dict[str, Drawing]()
    _warm_up()
    for line in sys.stdin:
        plan_of, arguments = pickle.loads(Path(line.rstrip("\n")).read_bytes())
        plan = plan_of(*arguments)
        found |= _drawings(plan, reversed(list(plan)), claims)
    sys.stdout.buffer.write(pickle.dumps(found))


def _warm_up() -> None:
    """Draw something: that reads fonts and imports what draws."""
    with figure_style():
        figure = new_figure(1.0, 1.0)
        figure.subplots().set_title("$x$")
    drawing_of(figure)
