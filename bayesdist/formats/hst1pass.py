"""Star lists of hst1pass (`*.uvwXYMpq`, `*.xymq`) and the MATCHUP masters made from them.

hst1pass is J. Anderson's one-pass photometry of HST exposures (WFC3 ISR 2022-05); jwst1pass is the
equivalent for JWST. A list names its columns in the block after FILEOUT near the end of its header.
In lists without such a block, from older or other programs, each letter of the file suffix denotes
a column.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from bayesdist.data.catalog import ReferenceCatalog
from bayesdist.data.detections import Detections
from bayesdist.data.formats import MatchFormat
from bayesdist.data.matches import Matches
from bayesdist.errors import FormatError
from bayesdist.files.tables import is_binary
from bayesdist.files.unpacked import read_lines
from bayesdist.utils.arrays import Float, Int
from bayesdist.utils.text import number_of

_COLUMN = re.compile(r"#\s*\((\d+)\)\s+(\S+)\s+--\s")
_KEYWORD = re.compile(r"#\s*(\w+)\s*:\s*(.*?)\s*$")
_SUFFIX = re.compile(r"\w*(xym|XYM|XYm)\w*")
_LABELS = "IJN"  # row, column and number of a star as text labels: I0042, J0817, N00007
_CHIP = "kK"  # chip, as a number or a label such as K1
_ROWS = 2048  # rows of the lower chip in a frame that contains both chips
_DAMAGED = "fetch or write the file again"


@dataclass(frozen=True, eq=False)
class Hst1passList:
    """One hst1pass list.

    Parameters
    ----------
    name : str
        Name of the exposure: the file name up to its first point.
    source : str
        Name of the file.
    columns : dict of str to ndarray, shape (N,)
        Columns by the letters of hst1pass: u, v positions corrected with the observatory's
        solution; x, y raw pixels, FITS 1-based, and X, Y those corrected for charge transfer; m, M,
        w instrumental magnitudes: raw, corrected for charge transfer, and of undistorted pixels; p
        peak; q quality of fit.
    filter : str
        Filter; empty if the header has none.
    epoch : float or None
        Decimal year, from rDAT.
    exptime : float or None
        Exposure time in seconds, from EXPTI.
    two_chips : bool
        True if the header describes a detector with two chips in one frame of 4096 x 4096 pixels.
    """

    name: str
    source: str
    columns: dict[str, Float]
    filter: str
    epoch: float | None
    exptime: float | None
    two_chips: bool = False

    def matches(self, *, name: str | None = None) -> Matches:
        """Matches of raw pixels with the observatory's corrected positions.

        Pixels are X, Y, or x, y if the list has no X, Y. The block after FILEOUT calls X, Y
        "dist-cor", but they are raw: the header's BDRY_xy and BDRY_uv rows give the corners of the
        chip in both systems.

        Parameters
        ----------
        name : str, optional
            Name of the exposure.

        Returns
        -------
        Matches
            Matches in pixels without errors, with magnitudes M, or m if the list has no M.

        Raises
        ------
        FormatError
            If the list lacks pixels, u or v.
        """
        x, y = self._pair(("X", "Y"), ("x", "y"))
        u, v = self._pair(("u", "v"))
        chip, y = self._on_chips(y)
        numbers, codes = np.unique(chip, return_inverse=True)
        return Matches(
            x=x,
            y=y,
            u=u,
            v=v,
            chip=codes,
            chip_numbers=tuple(numbers.tolist()),
            mag=self._mag,
            epoch=None if self.epoch is None else np.full(len(x), self.epoch),
            exposure_names=(self.name if name is None else name,),
            filter_names=(self.filter,),
            sources=(self.source,),
        )

    def detections(self, *, name: str | None = None) -> Detections:
        """Raw pixels, instrumental magnitudes and qualities q of the detections.

        Pixels are X, Y, or x, y if the list has no X, Y. Magnitudes are M, or m if it has no M.

        Parameters
        ----------
        name : str, optional
            Name of the exposure.

        Returns
        -------
        Detections
            Detections without errors.

        Raises
        ------
        FormatError
            If the list lacks pixels.
        """
        x, y = self._pair(("X", "Y"), ("x", "y"))
        chip, y = self._on_chips(y)
        return Detections(
            x=x,
            y=y,
            chip=chip,
            exposure_names=(self.name if name is None else name,),
            mag=self._mag,
            q=self.columns.get("q"),
            source=self.source,
        )

    def _on_chips(self, y: Float) -> tuple[Int, Float]:
        """Chip of each star (N,), and the row coordinate on that chip.

        hst1pass places the two chips of ACS/WFC and WFC3/UVIS in one frame, k = 1 below k = 2.
        Chips are converted to CCDCHIP, with 2 below 1, as in other HST files. Rows are converted to
        rows of the chip, unless they already are. A list without k has a single chip, number 1.
        """
        k = next((self.columns[name] for name in _CHIP if name in self.columns), None)
        if k is None:
            return np.ones(len(y), np.int64), y
        chip = k.astype(np.int64)
        if not (self.two_chips or set(chip.tolist()) == {1, 2}):
            return chip, y
        in_frame = bool((y[chip == 2] > _ROWS).all())
        return 3 - chip, y - _ROWS * (chip - 1) if in_frame else y

    @property
    def _mag(self) -> Float | None:
        return self.columns.get("M", self.columns.get("m"))

    def _pair(self, *pairs: tuple[str, str]) -> tuple[Float, Float]:
        """Columns of the first of these pairs that the list has."""
        for a, b in pairs:
            if a in self.columns and b in self.columns:
                return self.columns[a], self.columns[b]
        wanted = " or ".join(", ".join(pair) for pair in pairs)
        raise FormatError(
            f"has no columns {wanted} (it has {' '.join(self.columns)})",
            where=self.source,
            do="run hst1pass with OUT=uvwXYMpq",
        )


def is_hst1pass(path: Path) -> bool:
    """True for an hst1pass list, recognised by its lines or its suffix."""
    return bool(_suffix_letters(path)) or any(
        line.startswith("#") and "FILEOUT:" in line for line in _text_lines(path)
    )


def is_matchup(path: Path) -> bool:
    """True if a file begins like a MATCHUP master or a calibrated form of it."""
    return _names_matchup(_text_lines(path))


def _text_lines(path: Path) -> list[str]:
    """Lines of a text file; empty for a binary file."""
    return [] if is_binary(path) else read_lines(path)


def _suffix_letters(path: Path) -> list[str]:
    """Letters of a suffix such as `.xymq`, which name the columns; empty for other suffixes."""
    letters = path.name.removesuffix(".gz").partition(".")[2].rpartition(".")[2]
    # excludes MATCHUP.XYMEEE
    named = _SUFFIX.fullmatch(letters) and len(set(letters)) == len(letters)
    return list(letters) if named else []


def _names_matchup(lines: list[str]) -> bool:
    """True if the lines begin like a MATCHUP master or a calibrated form of it."""
    head = lines[:5]
    return any(line.startswith("#") and "xbar" in line and "ysig" in line for line in head) or (
        bool(head) and {"x", "y", "m", "xe", "ye", "N_fnd"} <= set(head[0].split())
    )


def read_hst1pass(path: str | Path) -> Hst1passList:
    r"""Read an hst1pass list.

    Parameters
    ----------
    path : path-like
        Text file, optionally compressed.

    Returns
    -------
    Hst1passList
        Columns and header values of the list.

    Raises
    ------
    InputError
        If the file is missing, if neither a FILEOUT block nor the suffix names the columns, if
        there are no rows, or if rows lack columns (a truncated file).

    Examples
    --------
    >>> from bayesdist.formats import read_hst1pass
    >>> from pathlib import Path
    >>> head = "# FILEOUT:\n# (1) X -- raw\n# (2) Y -- raw\n# (3) M -- magnitude\n"
    >>> n = Path("j8c0.uvwXYMpq").write_text(head + "100.5 200.25 -9.5\n")
    >>> one = read_hst1pass("j8c0.uvwXYMpq")
    >>> one.name, one.detections().x.tolist()
    ('j8c0', [100.5])
    """
    path = Path(path)
    lines = read_lines(path)
    header = [line for line in lines if line.startswith("#")]
    start = next((k for k, line in enumerate(header) if "FILEOUT:" in line), None)
    if start is None:
        names = _suffix_letters(path)
    else:
        names = [match[2] for line in header[start:] if (match := _COLUMN.match(line))]
    if not names:
        problem = "the FILEOUT block names no columns"
        if start is None:
            problem = (
                "is no hst1pass list, or its header is cut off: no FILEOUT block names the "
                "columns, and no suffix such as .xymq"
            )
        raise FormatError(problem, where=str(path), do=_DAMAGED)
    numeric = [k for k, name in enumerate(names) if name not in _LABELS]
    values = _numbers(path, lines, len(names), numeric)
    keywords = {match[1]: match[2] for line in header if (match := _KEYWORD.match(line))}
    return Hst1passList(
        name=path.name.split(".")[0],
        source=str(path),
        columns={names[k]: values[:, m].copy() for m, k in enumerate(numeric)},
        filter=keywords.get("FILT", "").strip("' "),
        epoch=_float(keywords.get("rDAT")),
        exptime=_float(keywords.get("EXPTI")),
        two_chips="BDRY_xy_K2" in keywords and "BDRY_xy_K3" not in keywords,
    )


def _float(text: str | None) -> float | None:
    try:
        value = number_of(text or "")
    except ValueError:
        return None
    return value if np.isfinite(value) else None


def _numbers(path: Path, lines: list[str], n_columns: int, kept: Sequence[int]) -> Float:
    """Fields with indices `kept`, out of `n_columns` leading ones, of all rows except comments."""
    rows = [line for line in lines if line.strip() and not line.startswith("#")]
    if not rows:
        raise FormatError("holds no stars", where=str(path), do="give a list with stars")
    if not lines[-1].endswith("\n"):
        raise FormatError("the last line is cut off", where=str(path), do=_DAMAGED)
    out = np.empty((len(rows), len(kept)))
    for k, line in enumerate(rows):
        try:
            fields = _fields(line, n_columns)
            out[k] = [fields[m].removeprefix("K") for m in kept]
        except ValueError as error:
            raise FormatError(str(error), where=f"{path}, row {k + 1}", do=_DAMAGED) from None
    return out


def _fields(line: str, n_columns: int) -> list[str]:
    """Fields of a row; raises ValueError if there are fewer than `n_columns`, or for odd ones."""
    fields = line.split()
    if len(fields) < n_columns:
        raise ValueError(f"has {len(fields)} of {n_columns} columns")
    if "_" in line or not line.isascii():  # Python would accept these as parts of numbers
        raise ValueError(f"{line.strip()[:40]!r} contains characters that are not part of a number")
    return fields


def read_matchup(
    path: str | Path, *, epoch: float | None = None, unit: str = "pix"
) -> ReferenceCatalog:
    r"""Read a MATCHUP master as a reference catalogue.

    Two forms are supported: the original one (xbar ybar mbar xsig ysig msig qbar Nf ...) and the
    calibrated one with a header line (x y m xe ye me std N_fnd ... name t). In existing files of
    the second form, t is the same for years of observations, so it is not an epoch of the positions
    and is not used.

    Parameters
    ----------
    path : path-like
        Text file, optionally compressed.
    epoch : float, optional
        Decimal year of the positions, which the file does not state.
    unit : str, optional
        Unit of the positions.

    Returns
    -------
    ReferenceCatalog
        Catalogue in which sigma_u, sigma_v are xsig, ysig: the scatter over the exposures, not the
        error of the mean.

    Raises
    ------
    InputError
        If the file is missing, is not a MATCHUP master, or is truncated.

    Examples
    --------
    >>> from bayesdist.formats import read_matchup
    >>> from pathlib import Path
    >>> head = "# xbar ybar mbar xsig ysig msig\n"
    >>> n = Path("MATCHUP").write_text(head + "1 2 -9.5 0.01 0.02 0.05\n")
    >>> master = read_matchup("MATCHUP", epoch=2011.8)
    >>> master.sigma_v.tolist()
    [0.02]
    """
    path = Path(path)
    lines = read_lines(path)
    if not _names_matchup(lines):
        raise FormatError(
            "is no MATCHUP master: its head names no xbar, ybar, ... and no x, y, m, xe, ye, ...",
            where=str(path),
            do="set the format to that of the file",
        )
    if not lines[0].startswith("#"):
        lines = ["#" + lines[0], *lines[1:]]
    x, y, m, xsig, ysig, _ = _numbers(path, lines, 6, range(6)).T
    return ReferenceCatalog(
        u=x, v=y, sigma_u=xsig, sigma_v=ysig, mag=m, epoch=epoch, unit=unit, source=str(path)
    )


HST1PASS = MatchFormat(
    is_hst1pass,
    detections=lambda path, name: read_hst1pass(path).detections(name=name),
    matches=lambda path, name: read_hst1pass(path).matches(name=name),
    lacking=lambda path: [key for key in ("u", "v") if key not in read_hst1pass(path).columns],
)
MATCHUP = MatchFormat(is_matchup, master=read_matchup, lists="hst1pass")
