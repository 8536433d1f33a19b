"""Runs that leave out what takes most of the time of a small one, and what other tests look at.

Figures of reports are made but not drawn, or not even made; as they look they are the subject of
tests/report.
"""

from __future__ import annotations

import io
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from unittest.mock import patch

import numpy as np
from PIL import Image


@contextmanager
def sketched(*, made: bool = True) -> Iterator[None]:
    """Context in which a speck stands for each figure of a report, and corner plots are empty.

    Figures of a run that are not `made` have their names in place of words.
    """
    from bayesdist.report import drawing, run_report
    from bayesdist.report.sections import posterior

    with (
        patch.object(drawing, "render", _sketch),
        patch.object(posterior, "draw_corner", lambda *_, **__: None),
        patch.object(run_report, "draw_all", drawing.draw_all if made else _unmade),
    ):
        yield


@contextmanager
def quick() -> Iterator[None]:
    """Context in which figures of runs are not made, and what else takes long is left out.

    Posteriors leave out what those of large runs do, the likelihood of each star at each draw: a
    fifth of a small run, and tests/infer/posterior/test_files looks at it.  Structure that a fit
    leaves out is integrated over a coarse grid of its sizes: a tenth, which tests/diagnose tests.
    Requirements are followed through time at few dates.
    """
    structure = "bayesdist.diagnose.correlated.structure"
    with (
        sketched(made=False),
        patch("bayesdist.infer.posterior.files.LARGEST", 0),
        patch(f"{structure}.LENGTHS", np.geomspace(0.02, 0.6, 3)),
        patch(f"{structure}.HALVINGS", 2),
        patch("bayesdist.assess.evaluation.VALIDITY_EPOCHS", 10),
    ):
        yield


def _sketch(plot, kind="png", *, pdf=False):
    """The words of a figure, and a speck in place of it."""
    from bayesdist.report.drawing import Drawing

    page = b"<svg xmlns='http://www.w3.org/2000/svg' width='3pt' height='2pt'/>"
    if kind == "png":
        pixels = io.BytesIO()
        Image.new("RGB", (4, 3), "white").save(pixels, format="png")
        page = pixels.getvalue()
    words = plot.title, plot.text, plot.alt
    return Drawing(page, kind, 0.04, b"%PDF-1.7" if pdf else None, *words)


def _unmade(registry, results, *, pdf=False, processes=1):
    """A speck for each figure that the results have."""
    from matplotlib.figure import Figure

    from bayesdist.report.contents import Plot

    names = [item.name for item in registry.items(results, "figure")]
    return {name: _sketch(Plot(Figure(), name, name, name), pdf=pdf) for name in names}


def main() -> int:
    """Exit code of a command of bayesdist whose runs are quick."""
    from bayesdist.app.cli import main as command
    from bayesdist.app.screen import open_streams

    open_streams()  # as `command` does, here before numpy 2.0 writes to a closed one
    with quick():
        return command(sys.argv[1:])


if __name__ == "__main__":
    sys.exit(main())
