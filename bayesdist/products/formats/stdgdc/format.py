"""Format entry of STDGDC files."""

from __future__ import annotations

import numpy as np

from bayesdist.products.formats.common.document import Format, finding_lines
from bayesdist.products.formats.stdgdc.build import Settings, build
from bayesdist.products.formats.stdgdc.file import SIGMAS, StdGdc, stdgdc_calibration, stdgdc_of
from bayesdist.products.formats.stdgdc.lint import lint_stdgdc


def _describe(file: StdGdc) -> list[str]:
    """Lines of text on the tables, their findings at the end."""
    findings = lint_stdgdc(file)
    lines = [f"{file.name}: STDGDC"]
    if not {"XGC", "YGC"} & set(file.missing):
        nx, ny = file.size
        lines[0] += f" of {nx} x {ny} px"
        xgc, ygc = file.table("XGC"), file.table("YGC")
        if xgc.shape == ygc.shape:
            far = np.hypot(xgc - np.arange(1, nx + 1), ygc - np.arange(1, ny + 1)[:, None])
            lines.append(f"  moves     pixels by up to {far.max():.4g} px")
    if "MGC" not in file.missing:
        mgc = file.table("MGC")
        lines.append(f"  MGC       {mgc.min():.4f} to {mgc.max():.4f} mag")
    if "BDWORST" in file.header:
        lines.append(f"  precision {file.header['BDWORST']:.2g} px, rounding and between nodes")
    if file.hdu(SIGMAS[0]) is not None:
        medians = [float(np.median(file.table(name))) for name in SIGMAS[:2]]
        lines.append(f"  errors    {medians[0]:.3g} and {medians[1]:.3g} px in the median")
    return [*lines, "", *finding_lines(findings)]


FORMAT = Format(
    "stdgdc", "an STDGDC file", 32, stdgdc_of, _describe, lint_stdgdc, stdgdc_calibration,
    Settings, build, holds_tables=True,
)  # fmt: skip
