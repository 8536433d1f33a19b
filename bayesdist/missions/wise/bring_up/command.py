"""`bayesdist wise bring-up`: pairs and distortion from unmatched star lists."""

from __future__ import annotations

from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
from astropy.table import Table

from bayesdist.app.screen import table_text
from bayesdist.app.store.output import record_folder, write_table
from bayesdist.data.detections import Detections
from bayesdist.data.repeated import first_duplicate
from bayesdist.data.tables.checks import row_number
from bayesdist.data.tables.column import SourceColumn
from bayesdist.data.tables.names import find_columns
from bayesdist.errors import InputError
from bayesdist.files.tables import read_table
from bayesdist.missions.wise.bands.optical import optical_models
from bayesdist.missions.wise.bring_up.iterate import BringUp, bring_up
from bayesdist.missions.wise.pairs.files import RVB_ALIASES, band_name
from bayesdist.missions.wise.pairs.radial_limit import RadialLimit
from bayesdist.missions.wise.pairs.rvb_pairs import RvbPairs, write_rvb
from bayesdist.missions.wise.published import WISE_ARRAYS
from bayesdist.model import Chip, DistortionModel
from bayesdist.utils.arrays import Float

_COLUMNS = {
    "x": ("x",),
    "y": ("y",),
    "sigma": ("sigma",),
    "frame": RVB_ALIASES["exposure"],
}
_SHOWN = ("order", "n_pairs", "n_believed", "n_false", "coverage", "rms", "moved")


def bring_up_files(
    detections: str | Path,
    reference: str | Path,
    output: str | Path,
    *,
    band: str,
    radius: float,
    corner_radius: float,
    order: int,
    optical: str | Path | None,
    rotation: float,
    command: str,
) -> str:
    """Match and fit star lists, and write the resulting pairs; returns text to print.

    Positions of the reference stars are those on an undistorted array in the frame, in pixels.  The
    new folder contains pairs/ for `format = "rvb"`, and rounds.ecsv.
    """
    band = band_name(band)
    array = WISE_ARRAYS[band]
    model = DistortionModel(order, (Chip(1, band, array.size, array.centre),))
    start = None if optical is None else _start(model, band, optical, rotation)
    stars, reference_stars = _read_lists(Path(detections), Path(reference))
    up = bring_up(
        stars, reference_stars, model, start, acceptance=RadialLimit(radius, corner_radius)
    )
    rows = [{"round": k, **asdict(bring_up_round)} for k, bring_up_round in enumerate(up.rounds, 1)]
    rows = [{name: row[name] for name in ("round", *_SHOWN)} for row in rows]
    with record_folder(Path(output), "bring_up.json", command) as (folder, record):
        write_rvb([_pairs(up, band)], folder / "pairs")
        write_table(Table(rows), folder / "rounds.ecsv")
        record |= {"band": band, "order": order, "verdict": up.sentence}
    return f"{table_text(rows, 4)}\n{up.sentence}\n{output}/pairs: calibrate with format = 'rvb'"


def _start(model: DistortionModel, band: str, optical: str | Path, rotation: float) -> Float:
    """Parameters of an optical model, without terms beyond the order of the model."""
    chip = model.chips[0]
    field = optical_models([optical], rotation, [band])[band].field(chip, WISE_ARRAYS[band].scale)
    basis = model.basis()
    coefficients = np.zeros((2, basis.n_terms))
    n = min(basis.n_terms, field.polynomial.shape[1])
    coefficients[:, :n] = field.polynomial[:, :n]
    # add the pixel positions to the distortion
    coefficients[:, 0] += chip.reference_pixel
    coefficients[:, 1:3] += np.diag(basis.half_size)
    return coefficients.ravel()


def _read_lists(*paths: Path) -> list[Detections]:
    """Read star lists and number their frames consistently."""
    columns, frames = [], []
    for path in paths:
        table = read_table(path)
        column_of = find_columns(table.colnames, None, _COLUMNS, source=str(path))
        missing = [name for name in _COLUMNS if name not in column_of]
        if missing:
            raise InputError(
                f"has no column {missing[0]!r} among {', '.join(table.colnames)}",
                where=str(path),
                do="give x, y, sigma and frame",
            )
        column = {name: SourceColumn(table[key], str(path), key) for name, key in column_of.items()}
        columns.append([column[name].numbers() for name in ("x", "y", "sigma")])
        codes, names = column["frame"].labels()
        pair = first_duplicate([*columns[-1], codes])
        if pair is not None:
            first, second = map(row_number, pair)
            raise InputError(
                f"repeats {first}", where=f"{path}, {second}", do="list each detection once"
            )
        frames.append(np.array(names, str)[codes])
    unique, code = np.unique(np.concatenate(frames), return_inverse=True)
    parts = np.split(code, np.cumsum([len(column) for column in frames])[:-1])
    numbers = tuple(map(str, range(len(unique))))
    return [
        Detections(x, y, part, numbers, sigma=sigma, source=str(path))
        for (x, y, sigma), part, path in zip(columns, parts, paths, strict=True)
    ]


def _pairs(up: BringUp, band: str) -> RvbPairs:
    """Accepted pairs of the last round."""
    return RvbPairs(replace(up.matches, filter_names=(band,)))
