"""The figure of dither patterns."""

from __future__ import annotations

import numpy as np
import pytest
from matplotlib.collections import QuadMesh

from bayesdist.kinds.selfcal.patterns.command import pattern_maps
from bayesdist.kinds.selfcal.patterns.dithers import (
    Camera,
    PlannedStars,
    PriorInformation,
    compare_patterns,
)
from bayesdist.kinds.selfcal.patterns.exposures import DitherPattern, flat_coefficients
from bayesdist.model import Chip
from bayesdist.report.drawing import png_of

SIZE = (400.0, 200.0)


@pytest.fixture(scope="module")
def planned():
    chips = tuple(Chip(k, f"C{k}", SIZE, (200.0, 100.0)) for k in (1, 2))
    offsets = np.array([[0, 0], [50, 120], [150, -60], [-120, 300.0], [80, 80]])
    patterns = [
        DitherPattern("turned", offsets, np.radians([0, 50, 100, 0, 50])),
        DitherPattern("straight", offsets, np.zeros(5)),
    ]
    camera = Camera(chips, flat_coefficients(2, chips))
    return compare_patterns(patterns, camera, PlannedStars(300.0, 0.02), PriorInformation())


def test_footprints_and_maps_at_one_scale(planned):
    fig = pattern_maps(planned)
    panels = np.array([ax for ax in fig.axes if ax.get_label() != "<colorbar>"]).reshape(2, 3)
    for row, one in zip(panels, planned, strict=True):
        assert one.pattern.name in row[0].get_title(loc="left")
        # two chips in five exposures; corners of the last one drawn, which is the first exposure
        assert len(row[0].lines) == 10
        outline = row[0].lines[-1].get_xydata()
        assert np.ptp(outline, axis=0) == pytest.approx(SIZE)
        # along the sky of the first exposure the far exposure lies where it is pointed
        far = max(line.get_ydata().max() for line in row[0].lines)
        assert far == pytest.approx(300 + 350, abs=60 if one.pattern.rolls.any() else 1)
    meshes = [c for ax in panels[:, 1:].ravel() for c in ax.collections if isinstance(c, QuadMesh)]
    assert len(meshes) == 2 * 3  # without rolls nothing bounds the shape
    assert panels[1, 2].get_title(loc="left") == "not bounded"
    assert len({(m.norm.vmin, m.norm.vmax) for m in meshes}) == 1
    values = np.concatenate([np.ravel(m.get_array()) for m in meshes])
    assert np.isfinite(values).all() and meshes[0].norm.vmax >= values.max()
    assert len({(ax.get_xlim(), ax.get_ylim()) for ax in panels[:, 0]}) == 1
    assert png_of(fig).startswith(b"\x89PNG")
