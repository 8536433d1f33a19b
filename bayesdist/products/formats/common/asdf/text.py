"""Text on a distortion reference file."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from bayesdist.errors import BayesdistError
from bayesdist.products.formats.common.asdf.distortion import DistortionFile, closure_of, recorded
from bayesdist.products.formats.common.asdf.transforms import leaves, order_of, tables_of
from bayesdist.products.formats.common.document import Finding, finding_lines

__all__ = ["describe_distortion"]


def describe_distortion(file: DistortionFile, findings: Sequence[Finding]) -> list[str]:
    """Lines of text on a file, its findings at the end."""
    meta, instrument = file.meta, file.meta.get("instrument", {})
    named = [str(instrument[k]) for k in ("name", "detector") if instrument.get(k)]
    lines = [f"{file.name}: {file.observatory} distortion of {'/'.join(named) or '(unnamed)'}"]
    elements = [
        str(instrument[k]) for k in ("filter", "pupil", "optical_element") if instrument.get(k)
    ]
    if elements:
        lines.append(f"  filter    {' '.join(elements)}")
    lines += [
        f"  {label:<9} {meta[key]}"
        for label, key in (("about", "description"), ("useafter",) * 2, ("pedigree",) * 2)
        if key in meta
    ]
    kinds = [type(one).__name__ for one in leaves(file.model)]
    order, tables = order_of(file.model), tables_of(file.model)
    lines.append(
        f"  model     {len(kinds)} parts"
        + (f", polynomial of order {order}" if order else "")
        + (f", {len(tables)} look-up tables" if tables else "")
    )
    if file.size is not None:
        lines += _measured(file, file.size)
    lines += _uncertainty(file)
    return [*lines, "", *finding_lines(findings)]


def _measured(file: DistortionFile, size: tuple[float, float]) -> list[str]:
    """Lines on what the transform gives."""
    middle = [(n + 1) / 2 for n in size]
    at = file.v2v3(
        [middle[0], middle[0] + 0.5, middle[0] - 0.5, middle[0], middle[0]],
        [middle[1], middle[1], middle[1], middle[1] + 0.5, middle[1] - 0.5],
    )
    slope = np.stack([at[:, 1] - at[:, 2], at[:, 3] - at[:, 4]], axis=1)
    area = float(np.linalg.det(slope))
    lines = [
        f"  detector  {size[0]:g} x {size[1]:g} px",
        f"  V2, V3    {at[0, 0]:.6f}, {at[1, 0]:.6f} arcsec at its middle",
        f"  pixel     {np.sqrt(abs(area)):.8f} arcsec, parity {'-1' if area < 0 else '+1'}",
    ]
    back = file.inverse
    if back is not None:
        lines.append(f"  inverse   {closure_of(file.model, back, *file.grid()):.2g} px at worst")
    return lines


def _uncertainty(file: DistortionFile) -> list[str]:
    """Lines on the record."""
    if file.record is None:
        return ["  errors    none stated"]
    try:
        found = recorded(file, file.record)
        [chip] = found.by_chip().values()
        cov = chip.covariance_at(*file.grid())
    except BayesdistError:
        return ["  errors    of a record that cannot be read"]
    if cov is None:
        lines = ["  errors    none stated"]
    else:
        sigma = 1e3 * np.sqrt((cov[:, 0, 0] + cov[:, 1, 1]) / 2)
        lines = [
            f"  errors    {found.errors}: {np.median(sigma):.3g} mas per axis at the median, "
            f"{sigma.max():.3g} at worst"
        ]
    lines.append(f"  gauge     {file.record['gauge']}")
    provenance = file.record["provenance"]
    lines.append(f"  from      {provenance['source']} by {provenance['software']}")
    return lines
