"""Parameters of a calibration and their covariance as a FITS table, for any format.

Most formats have no room for a covariance. This table holds the full covariance, in double
precision, at one date. It has one row per Legendre coefficient. It is the extension BDPARAM of the
product itself, or a FITS file in the same folder if the product is a text file, which then states
its name. With X = (2 x - (NX + 1)) / NX, the corresponding Y, and FITS 1-based pixels x and y, the
position of a pixel is

    u = sum VALUE P_I(X) P_J(Y)    over the rows of its CHIP with AXIS 'u',

and COV is the row of the covariance matrix, in the order of the table rows. Position errors that
the covariance does not include are listed in the header: BDNAMEn, BDKINDn, and the standard
deviations BDSIGUn and BDSIGVn of u and v. Look-up tables are not included; the product holds them.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from astropy.io import fits

from bayesdist.calibration.calibration import Calibration
from bayesdist.calibration.chip_map import further_from
from bayesdist.calibration.inverse import detector_grid
from bayesdist.calibration.plane import Plane
from bayesdist.errors import FormatError
from bayesdist.infer.solution.solution import GaussianSolution
from bayesdist.model import Chip, DistortionModel
from bayesdist.products.common.cards import named_in, set_text, set_value
from bayesdist.products.common.content import Content, Hdu, fits_bytes

EXTENSION = "BDPARAM"
AGREE = 1e-6  # pixels; tolerance between the printed coefficients of a file and its parameters
_SLACK = 1e-9  # pixels; rounding error of the check itself
_GRID = 33  # grid points per axis at which two calibrations are compared
_PLANES = ("free", "sky", "detector", "aperture")
_ERRORS = ("covariance", "sigma", "none")
# numbered header cards of the errors that COV does not include
_FURTHER = {"name": "NAME", "kind": "KIND", "u": "SIGU", "v": "SIGV", "source": "FROM"}


def parameters_hdu(calibration: Calibration, epoch: float | None = None) -> fits.BinTableHDU:
    """Table of all parameters and their covariance at one date."""
    model = calibration.model
    dated = calibration.at_date(epoch)
    mean, cov = np.asarray(dated.solution.mean), np.asarray(dated.solution.cov)
    basis = model.basis()
    rows = [(c, a, i, j) for c in model.chips for a in "uv" for i, j in basis.terms]
    D = len(rows)
    columns = [
        fits.Column("CHIP", "J", array=[c.number for c, *_ in rows]),
        fits.Column("AXIS", "1A", array=[a for _, a, *_ in rows]),
        fits.Column("I", "J", array=[i for *_, i, _ in rows]),
        fits.Column("J", "J", array=[j for *_, j in rows]),
        fits.Column("VALUE", "D", array=mean[:D]),
        fits.Column("SIGMA", "D", array=np.sqrt(np.maximum(np.diag(cov)[:D], 0.0))),
        fits.Column("COV", f"{D}D", array=cov[:D, :D]),
        fits.Column("NX", "D", array=[c.size[0] for c, *_ in rows]),
        fits.Column("NY", "D", array=[c.size[1] for c, *_ in rows]),
        fits.Column("XREF", "D", array=[c.reference_pixel[0] for c, *_ in rows]),
        fits.Column("YREF", "D", array=[c.reference_pixel[1] for c, *_ in rows]),
    ]
    hdu = fits.BinTableHDU.from_columns(columns, name=EXTENSION)
    header = hdu.header
    set_text(header, "BDUNIT", model.unit, "unit of u and v")
    header["BDORDER"] = model.order, "order of the polynomials"
    set_text(header, "BDERROR", calibration.errors, "covariance, sigma (no correlations) or none")
    header["BDNUMB"] = calibration.numbered, "are the chips numbered?"
    set_text(header, "BDPLANE", calibration.plane.kind, "plane of u and v")
    if calibration.plane.point is not None:
        for k, value in enumerate(calibration.plane.point, start=1):
            header[f"BDTAN{k}"] = float(value), "[deg] sky position of u, v = 0"
    if epoch is not None and model.time is not None:
        header["BDEPOCH"] = float(epoch), "[yr] date of the coefficients"
    if calibration.scale is not None:
        header["BDSCALE"] = float(calibration.scale), "size of a corrected pixel"
    for keyword, text in (("DETECTOR", calibration.detector), ("FILTER", calibration.filter)):
        if text:
            set_text(header, keyword, text)
    for k, row in enumerate(calibration.further, start=1):
        set_text(header, f"BDNAME{k}", row.name)
        set_text(header, f"BDKIND{k}", row.kind)
        set_value(header, f"BDSIGU{k}", row.u, "standard deviation of u")
        set_value(header, f"BDSIGV{k}", row.v, "standard deviation of v")
        set_text(header, f"BDFROM{k}", row.source)
        if row.correlation:
            # fractions of the variance and their correlation lengths in pixels
            words = " ".join(f"{part:g}@{length:g}" for part, length in row.correlation)
            set_text(header, f"BDCORR{k}", words)
    header.add_comment("u = sum VALUE P_I(X) P_J(Y), P Legendre, X = (2 x - (NX + 1)) / NX")
    return hdu


def parameters_content(calibration: Calibration, epoch: float | None = None) -> bytes:
    """Content of a FITS file that holds only the parameter table, at `epoch` (decimal year)."""
    return fits_bytes([fits.PrimaryHDU(), parameters_hdu(calibration, epoch)])


def stored_in(content: Content) -> Hdu | None:
    """HDU of the parameter table in a file; None if the file has none."""
    return next((hdu for hdu in content.tables if hdu.name == EXTENSION), None)


def stored_calibration(hdu: Hdu, name: str) -> Calibration:
    """Calibration from the HDU of a parameter table.

    Raises FormatError if the table is incomplete or inconsistent; `name` is the file.
    """
    header, rows = hdu.header, hdu.rows
    location = f"{name}, extension {EXTENSION}"
    missing = {"CHIP", "AXIS", "I", "J", "VALUE", "COV", "NX", "NY", "XREF", "YREF"} - set(
        rows.dtype.names or ()
    )
    if missing:
        raise FormatError(
            f"has no column {min(missing)}", where=location, do="write the file again"
        )
    first = np.unique(rows["CHIP"], return_index=True)[1]
    chips = tuple(
        Chip(int(r["CHIP"]), str(r["CHIP"]), (float(r["NX"]), float(r["NY"])),
             (float(r["XREF"]), float(r["YREF"])))
        for r in rows[np.sort(first)]
    )  # fmt: skip
    model = DistortionModel(int(header["BDORDER"]), chips, str(header["BDUNIT"]), None)
    expected = [(c.number, a, *t) for c in chips for a in "uv" for t in model.basis().terms]
    stored_terms = [(int(r["CHIP"]), str(r["AXIS"]), int(r["I"]), int(r["J"])) for r in rows]
    cov = np.asarray(rows["COV"], float).reshape(len(rows), -1)
    if stored_terms != expected or cov.shape[0] != cov.shape[1]:
        raise FormatError(
            "does not have the rows for its order and chips",
            where=location,
            do="write the file again",
        )
    mean = np.asarray(rows["VALUE"], float)
    if not (np.isfinite(mean).all() and np.isfinite(cov).all()):
        raise FormatError("holds numbers that are not finite", where=location, do="check the file")
    kind, errors = str(header.get("BDPLANE", "free")), str(header.get("BDERROR", "covariance"))
    if kind not in _PLANES or errors not in _ERRORS:
        raise FormatError(f"is of a plane {kind!r}", where=location, do="write the file again")
    point = (float(header["BDTAN1"]), float(header["BDTAN2"])) if "BDTAN1" in header else None
    scale = float(header["BDSCALE"]) if "BDSCALE" in header else None
    return Calibration(
        name,
        GaussianSolution(model, mean, cov),
        plane=Plane(kind, point=point),
        detector=named_in(header, "DETECTOR", location),
        filter=named_in(header, "FILTER", location),
        errors=errors,
        numbered=bool(header.get("BDNUMB", True)),
        scale=scale,
        scale_from="" if scale is None else EXTENSION,
        further=further_from(_further(header), location),
    )


def _further(header: fits.Header) -> list[dict[str, Any]]:
    """Errors that the covariance does not include, read from the numbered header cards."""
    out: list[dict[str, Any]] = []
    while f"BDNAME{len(out) + 1}" in header:
        k = len(out) + 1
        cards = {key: f"BD{name}{k}" for key, name in _FURTHER.items()}
        row = {key: header[card] for key, card in cards.items() if card in header}
        words = str(header.get(f"BDCORR{k}", "")).split()
        out.append(row | {"correlation": [word.split("@") for word in words]})
    return out


def largest_difference(a: Calibration, b: Calibration, number: int, nodes: int = _GRID) -> float:
    """Largest distance between the positions of two calibrations on chip `number`, in pixels.

    The grid has `nodes` points along each axis.
    """
    x, y = detector_grid(a.model.chips[a.model.chip_code(number)].size, nodes)
    far = np.hypot(*(a.forward(x, y, chip=number) - b.forward(x, y, chip=number)).T)
    return float(far.max() / np.sqrt(abs(np.linalg.det(a.chip(number).linear))))


def refuse_other(far: float, most: float, where: str) -> None:
    """Raise FormatError if a file differs from its parameters by more than `most` pixels.

    `far` is the largest difference in pixels.
    """
    if not far <= most:
        raise FormatError(
            f"the parameters stored with it are off by {far:.2g} pixels: one was changed",
            where=where,
            do="use files that were written together",
        )


def agreeing(stored: Calibration, read: Calibration) -> Calibration:
    """Return the stored calibration, after checking that `read` agrees with it.

    `read` is the calibration read from the product.  Raises FormatError if chips or units differ,
    or if positions differ by more than `AGREE` pixels.
    """
    chips = [(c.number, c.size) for c in stored.model.chips]
    if chips != [(c.number, c.size) for c in read.model.chips] or stored.unit != read.unit:
        raise FormatError(
            "the parameters stored with it are for other chips or in another unit",
            where=read.name,
            do="use files that were written together",
        )
    far = max(largest_difference(stored, read, number) for number in stored.numbers)
    refuse_other(far, AGREE, read.name)
    return replace(stored, name=read.name, before=read.before, after=read.after, notes=read.notes)


def refuse_changed(off: float, header: fits.Header, where: str) -> None:
    """Raise FormatError if tables differ from the parameters by more than the header states.

    `off` is the largest difference in pixels.
    """
    if not off <= 1.5 * float(header.get("BDWORST", 0.0)) + _SLACK:
        raise FormatError(
            f"its tables are off by {off:.2g} pixels from its parameters: one was changed",
            where=where,
            do="write the file again",
        )


def with_parameters(
    found: Calibration,
    content: Content | None,
    named: str,
    agree: Callable[[Calibration, Calibration], Calibration] = agreeing,
) -> Calibration:
    """Calibration with the parameters stored in `content`, after checking that they agree.

    Parameters
    ----------
    found : Calibration
        Calibration read from the product without its stored parameters.
    content : Content or None
        File that may hold the parameter table.
    named : str
        Name of the file that should hold the parameters. If it is missing, a note says so.
    agree : callable
        ``agree(stored, found)`` returns the calibration to use, or raises FormatError.
    """
    hdu = None if content is None else stored_in(content)
    if hdu is not None:
        return agree(stored_calibration(hdu, found.name), found)
    if not named:
        return found
    note = f"its covariance is in {named}, which is not here"
    return replace(found, notes=(*found.notes, note))
