"""Text on a SIAF table of coefficients."""

from __future__ import annotations

import numpy as np

from bayesdist.calibration.inverse import detector_grid
from bayesdist.errors import BayesdistError
from bayesdist.products.formats.common.document import finding_lines
from bayesdist.products.formats.common.record import calibration_from
from bayesdist.products.formats.siaf.lint import lint_siaf
from bayesdist.products.formats.siaf.table import NAMES, SiafTable

__all__ = ["describe_siaf"]


def describe_siaf(table: SiafTable) -> list[str]:
    """Lines of text on a table or a side file, its findings at the end."""
    if not table.rows:
        lines = [f"{table.name}: covariance of the SIAF table of {table.aperture}"]
        return [*lines, *_uncertainty(table), "", *finding_lines(lint_siaf(table))]
    size = table.size
    extent = "unknown" if size is None else f"{size[0]:g} x {size[1]:g} px"
    lines = [
        f"{table.name}: SIAF table of {table.aperture}, order {table.order}",
        f"  detector  {extent}",
    ]
    if size is not None:
        x, y = table.reference_pixel(size)
        source = "" if "XSciRef" in table.stated else ", assumed: the middle"
        lines.append(f"  zero      pixel ({x:g}, {y:g}){source}")
    linear = np.array(
        [[table.terms(name).get(k, 0.0) for k in ((1, 0), (0, 1))] for name in NAMES[:2]]
    )
    lines.append(f"  pixel     {np.sqrt(abs(np.linalg.det(linear))):.8f} arcsec")
    closure = table.closure()
    if closure is not None:
        lines.append(f"  inverse   {closure:.2g} px at worst")
    lines += [*_uncertainty(table), "", f"  nj {' '.join(name.rjust(15) for name in NAMES)}"]
    for row in table.rows:
        lines.append(f"  {row.index} {' '.join(f'{value:15.7g}' for value in row.values)}")
    return [*lines, "", *finding_lines(lint_siaf(table))]


def _uncertainty(table: SiafTable) -> list[str]:
    if table.record is None:
        return ["  errors    none stated"]
    try:
        found = calibration_from(table.record, table.name)
    except BayesdistError:
        return ["  errors    of a side file that cannot be read"]
    [chip] = found.by_chip().values()
    cov = chip.covariance_at(*detector_grid(chip.basis.size, 65))
    if cov is None:
        return ["  errors    none stated"]
    sigma = 1e3 * np.sqrt((cov[:, 0, 0] + cov[:, 1, 1]) / 2)
    return [
        f"  errors    {found.errors}: {np.median(sigma):.3g} mas per axis at the median, "
        f"{sigma.max():.3g} at worst"
    ]
