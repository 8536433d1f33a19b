"""Star lists of hst1pass (`*.uvwXYMpq`) and the MATCHUP masters made from them.

hst1pass is J. Anderson's one-pass photometry of HST exposures (WFC3 ISR 2022-05).  A list names its
columns in the block under FILEOUT near the end of its header.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from bayesdist.data.catalog import ReferenceCatalog
from bayesdist.data.detections import Detections
from bayesdist.data.matches import Matches
from bayesdist.errors import FormatError
from bayesdist.reading.regular import read_lines

__all__ = ["Hst1passList", "is_hst1pass", "is_matchup", "read_hst1pass", "read_matchup"]

Float = NDArray[np.float64]

_COLUMN = re.compile(r"#\s*\((\d+)\)\s+(\S+)\s+--\s")
_KEYWORD = re.compile(r"#\s*(\w+)\s*:\s*(.*?)\s*$")
_DAMAGED = "fetch or write the file again"


@dataclass(frozen=True, eq=False)
class Hst1passList:
    """One list.

    Parameters
    ----------
    name : str
        File name up to its first point: the exposure.
    source : str
        File.
    columns : dict of str to ndarray, shape (N,)
        By the letters of hst1pass: u, v position corrected by the observatory's solution; X, Y raw
        pixels, FITS 1-based; w, M instrumental magnitudes; p peak; q quality of the fit.
    filter : str
        Empty where the header has none.
    epoch : float or None
        Decimal years, from rDAT.
    exptime : float or None
        Seconds, from EXPTI.
    """

    name: str
    source: str
    columns: dict[str, Float]
    filter: str
    epoch: float | None
    exptime: float | None

    def matches(self, *, name: str | None = None) -> Matches:
        """Matches of raw pixels with the observatory's corrected positions.

        The block under FILEOUT calls X, Y "dist-cor", but they are raw: the header's BDRY_xy and
        BDRY_uv rows give the corners of the chip in both systems.

        Parameters
        ----------
        name : str, optional
            Name of the exposure.

        Returns
        -------
        Matches
            In pixels, without errors; magnitudes are M.

        Raises
        ------
        FormatError
            When the list lacks one of X, Y, u, v.
        """
        self._require("XYuv")
        n = len(self.columns["X"])
        return Matches(
            x=self.columns["X"],
            y=self.columns["Y"],
            u=self.columns["u"],
            v=self.columns["v"],
            mag=self.columns.get("M"),
            epoch=None if self.epoch is None else np.full(n, self.epoch),
            exposure_names=(self.name if name is None else name,),
            filter_names=(self.filter,),
            sources=(self.source,),
        )

    def detections(self, *, name: str | None = None) -> Detections:
        """Raw pixels, instrumental magnitudes M and qualities q of the detections.

        Parameters
        ----------
        name : str, optional
            Name of the exposure.

        Returns
        -------
        Detections

        Raises
        ------
        FormatError
            When the list lacks X or Y.
        """
        self._require("XY")
        return Detections(
            x=self.columns["X"],
            y=self.columns["Y"],
            exposure_names=(self.name if name is None else name,),
            mag=self.columns.get("M"),
            q=self.columns.get("q"),
            source=self.source,
        )

    def _require(self, letters: str) -> None:
        """Refuse a list without one of these columns."""
        for letter in letters:
            if letter not in self.columns:
                raise FormatError(
                    f"has no column {letter!r} (it has {' '.join(self.columns)})",
                    where=self.source,
                    do="run hst1pass with OUT=uvwXYMpq",
                )


def is_hst1pass(lines: list[str]) -> bool:
    """True for lines of an hst1pass list."""
    return any(line.startswith("#") and "FILEOUT:" in line for line in lines)


def is_matchup(lines: list[str]) -> bool:
    """True for lines that begin as a MATCHUP master or one of its calibrated forms does."""
    head = lines[:5]
    return any(line.startswith("#") and "xbar" in line and "ysig" in line for line in head) or (
        bool(head) and {"x", "y", "m", "xe", "ye", "N_fnd"} <= set(head[0].split())
    )


def read_hst1pass(path: str | Path) -> Hst1passList:
    r"""Read one list.

    Parameters
    ----------
    path : path-like

    Returns
    -------
    Hst1passList

    Raises
    ------
    InputError
        For a missing file, a header without its FILEOUT block, no rows, or rows that do not have
        its columns (a truncated file).

    Examples
    --------
    >>> from pathlib import Path
    >>> head = "# FILEOUT:\n# (1) X -- raw\n# (2) Y -- raw\n# (3) M -- magnitude\n"
    >>> n = Path("j8c0.uvwXYMpq").write_text(head + "100.5 200.25 -9.5\n")
    >>> one = bd.read_hst1pass("j8c0.uvwXYMpq")
    >>> one.name, one.detections().x.tolist()
    ('j8c0', [100.5])
    """
    path = Path(path)
    lines = read_lines(path)
    header = [line for line in lines if line.startswith("#")]
    start = next((k for k, line in enumerate(header) if "FILEOUT:" in line), None)
    if start is None:
        raise FormatError(
            "is no hst1pass list, or its header is cut off: no FILEOUT block names the columns",
            where=str(path),
            do=_DAMAGED,
        )
    names = [found[2] for line in header[start:] if (found := _COLUMN.match(line))]
    if not names:
        raise FormatError("the FILEOUT block names no columns", where=str(path), do=_DAMAGED)
    values = _numbers(path, lines, len(names))
    keywords = {found[1]: found[2] for line in header if (found := _KEYWORD.match(line))}
    return Hst1passList(
        name=path.name.split(".")[0],
        source=str(path),
        columns={name: values[:, k].copy() for k, name in enumerate(names)},
        filter=keywords.get("FILT", "").strip("' "),
        epoch=_float(keywords.get("rDAT")),
        exptime=_float(keywords.get("EXPTI")),
    )


def _float(text: str | None) -> float | None:
    try:
        value = float(text or "")
    except ValueError:
        return None
    return value if np.isfinite(value) else None


def _numbers(path: Path, lines: list[str], n_columns: int) -> Float:
    """Leading `n_columns` fields of the rows that are no comments."""
    rows = [line for line in lines if line.strip() and not line.startswith("#")]
    if not rows:
        raise FormatError("holds no stars", where=str(path), do="give a list with stars")
    if not lines[-1].endswith("\n"):
        raise FormatError("the last line is cut off", where=str(path), do=_DAMAGED)
    out = np.empty((len(rows), n_columns))
    for k, line in enumerate(rows):
        fields = line.split()
        try:
            if len(fields) < n_columns:
                raise ValueError(f"has {len(fields)} of {n_columns} columns")
            out[k] = fields[:n_columns]
        except ValueError as error:
            raise FormatError(str(error), where=f"{path}, row {k + 1}", do=_DAMAGED) from None
    return out


def read_matchup(
    path: str | Path, *, epoch: float | None = None, unit: str = "pix"
) -> ReferenceCatalog:
    r"""Read a MATCHUP master as a reference catalogue.

    Two forms are known: the original (xbar ybar mbar xsig ysig msig qbar Nf ...) and the calibrated
    one with a header line (x y m xe ye me std N_fnd ... name t).  In known files of the second
    form, t is the same for years of observations: it is no epoch of the positions, and it is not
    used.

    Parameters
    ----------
    path : path-like
    epoch : float, optional
        Decimal year of the positions; the file does not hold it.
    unit : str, optional
        Unit of the positions.

    Returns
    -------
    ReferenceCatalog
        sigma_u, sigma_v are xsig, ysig: the scatter over the exposures, not the error of the mean.

    Raises
    ------
    InputError
        For a missing file, one that is no MATCHUP master, or rows cut off.

    Examples
    --------
    >>> from pathlib import Path
    >>> head = "# xbar ybar mbar xsig ysig msig\n"
    >>> n = Path("MATCHUP").write_text(head + "1 2 -9.5 0.01 0.02 0.05\n")
    >>> master = bd.read_matchup("MATCHUP", epoch=2011.8)
    >>> master.sigma_v.tolist()
    [0.02]
    """
    path = Path(path)
    lines = read_lines(path)
    if not is_matchup(lines):
        raise FormatError(
            "is no MATCHUP master: its head names no xbar, ybar, ... and no x, y, m, xe, ye, ...",
            where=str(path),
            do="set the format that the file has",
        )
    if not lines[0].startswith("#"):
        lines = ["#" + lines[0], *lines[1:]]
    x, y, m, xsig, ysig, _ = _numbers(path, lines, 6).T
    return ReferenceCatalog(
        u=x, v=y, sigma_u=xsig, sigma_v=ysig, mag=m, epoch=epoch, unit=unit, source=str(path)
    )
