"""`bayesdist wise bands`: write tables, figures and a page that compare finished runs."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path

from bayesdist.app.screen import table_text
from bayesdist.app.store.output import record_folder
from bayesdist.app.store.record import write_text
from bayesdist.errors import InputError
from bayesdist.formats.sip.build import sip_from_solution

# importing these modules registers their tables and figures
from bayesdist.missions.wise.bands import curves, figures, findings, tables  # noqa: F401
from bayesdist.missions.wise.bands.context import BANDS, BandsInput
from bayesdist.missions.wise.bands.findings import overview_table, verdict
from bayesdist.missions.wise.bands.inputs import BandRun, open_bands
from bayesdist.missions.wise.bands.measure import measure_bands
from bayesdist.missions.wise.bands.optical import optical_models
from bayesdist.missions.wise.bands.record import record_of, write_tables
from bayesdist.missions.wise.meta_data.build import write_wise_meta
from bayesdist.missions.wise.published import WISE_BANDS
from bayesdist.report.drawing import draw_all, save_drawings
from bayesdist.report.page import parts_of, template


def _page(inputs: BandsInput, folder: Path) -> list[str]:
    """Write bands.html and its figures to a folder; returns their names."""
    drawings = draw_all(BANDS, inputs, pdf=True)
    paths = save_drawings(drawings, folder / "figures")
    overview, *parts = parts_of(BANDS, inputs, drawings)
    page = template("bands.html.jinja", __package__)
    text = page.render(run=inputs, overview=overview, parts=parts, verdict=findings.verdict(inputs))
    write_text(folder / "bands.html", text)
    return ["bands.html", *(f"figures/{path.name}" for path in paths)]


log = logging.getLogger("bayesdist")

FEWEST_BINS = 6  # at least two blocks of three bins
META_ORDER = 4  # order of the inverse, as in WSDC D-T033, Appendix B


def bands_of_runs(
    runs: Sequence[str | Path],
    output: str | Path,
    *,
    bins: int,
    optical: Sequence[str | Path],
    rotation: float,
    published: bool,
    command: str,
) -> str:
    """Compare bands and write the results to a new folder; returns text to print.

    The folder is created only if all files can be written.
    """
    if bins < FEWEST_BINS:
        raise InputError(
            f"{bins} bins are too few to detect structure",
            where="--bins",
            do=f"give at least {FEWEST_BINS}",
        )
    with ExitStack() as stack:
        bands = open_bands(runs)
        for band in bands.values():
            stack.enter_context(band.run)
        recording = record_folder(Path(output), "bands.json", command)
        folder, record = stack.enter_context(recording)
        order = {str(band.run.directory.path): name for name, band in bands.items()}
        named = [order[str(Path(path))] for path in runs]
        inputs = measure_bands(
            bands,
            bins=bins,
            optical=optical_models(optical, rotation, named),
            published=published,
            provenance={"command": command, **record["versions"]},
        )
        files = [*write_tables(inputs, folder), *_meta(bands, folder), *_page(inputs, folder)]
        record |= {**record_of(inputs), "files": files}
    return _text(Path(output), inputs)


def _meta(bands: Mapping[str, BandRun], folder: Path) -> list[str]:
    """Write WISE meta-data if all bands are of WISE and in pixels; returns the file names."""
    models = [band.run.posterior.model for band in bands.values()]
    if not set(bands) <= set(WISE_BANDS) or any(model.unit != "pix" for model in models):
        return []
    headers = {
        int(name[1:]): sip_from_solution(
            band.run.solution,
            epoch=band.run.epoch,
            linear="sip",
            inverse_order=META_ORDER,
            scale_arcsec=band.arcsec,
        )
        for name, band in bands.items()
    }
    try:
        write_wise_meta(folder / "wise_meta.tbl", headers)
    except InputError as error:  # other array sizes, or orders that exceed the layout
        log.warning("bands: no wise_meta.tbl: %s", error.cause)
        return []
    return ["wise_meta.tbl"]


def _text(output: Path, inputs: BandsInput) -> str:
    table = overview_table(inputs)
    lines = [table_text([dict(zip(table.columns, row, strict=False)) for row in table.rows])]
    lines += [
        f"WARNING: {b.name} has not converged ({'; '.join(b.reasons)})"
        for b in inputs.not_converged
    ]
    lines += ["", verdict(inputs).headline]
    return "\n".join([*lines, "", f"page: {output / 'bands.html'}"])
