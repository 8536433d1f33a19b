"""`bayesdist wise bands`: write tables, figures and a page that compare finished runs.

For scripts there are bands.json and the residual tables as ECSV files.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import asdict
from pathlib import Path
from typing import TypedDict

import numpy as np
from astropy.table import Table

from bayesdist.app.screen import table_text
from bayesdist.app.store.record import record_folder, write_table, write_text
from bayesdist.errors import InputError
from bayesdist.formats.sip.build import sip_from_solution
from bayesdist.missions.wise.assess.account import RowAccount
from bayesdist.missions.wise.assess.distortion_field import ResidualHistogram
from bayesdist.missions.wise.assess.residual_tables import HEADS

# importing these modules registers their tables and figures
from bayesdist.missions.wise.bands import figures, findings  # noqa: F401
from bayesdist.missions.wise.bands.context import BANDS, BandResult, BandsInput
from bayesdist.missions.wise.bands.findings import overview_table, verdict
from bayesdist.missions.wise.bands.measure import BandRun, measure_bands, open_bands, optical_models
from bayesdist.missions.wise.meta_data.meta import write_wise_meta
from bayesdist.missions.wise.published import WISE_BANDS
from bayesdist.report.drawing import draw_all, save_drawings
from bayesdist.report.page import parts_of, template

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


def _page(inputs: BandsInput, folder: Path) -> list[str]:
    """Write bands.html and its figures to a folder; returns their names."""
    drawings = draw_all(BANDS, inputs, pdf=True)
    paths = save_drawings(drawings, folder / "figures")
    overview, *parts = parts_of(BANDS, inputs, drawings)
    page = template("bands.html.jinja", __package__)
    text = page.render(run=inputs, overview=overview, parts=parts, verdict=findings.verdict(inputs))
    write_text(folder / "bands.html", text)
    return ["bands.html", *(f"figures/{path.name}" for path in paths)]


def _text(output: Path, inputs: BandsInput) -> str:
    table = overview_table(inputs)
    lines = [table_text([dict(zip(table.columns, row, strict=False)) for row in table.rows])]
    lines += [
        f"WARNING: {b.name} has not converged ({'; '.join(b.reasons)})"
        for b in inputs.not_converged
    ]
    lines += ["", verdict(inputs).headline]
    return "\n".join([*lines, "", f"page: {output / 'bands.html'}"])


class BandsRecord(TypedDict):
    """Content of bands.json, apart from the command and versions."""

    converged: bool
    verdict: Mapping[str, str]  # level and headline
    n_bins: int
    optical: str | None
    bands: list[Mapping[str, object]]  # in the order of the tables
    differences: list[Mapping[str, object]]  # of later bands minus the first
    tables: Mapping[str, Mapping[str, object]]  # unit and rows, by table


def record_of(inputs: BandsInput) -> BandsRecord:
    """Content of bands.json, apart from the command and versions."""
    result = verdict(inputs)
    return {
        "converged": not inputs.provisional,
        "verdict": {"level": result.level, "headline": result.headline},
        "n_bins": inputs.n_bins,
        "optical": inputs.optical or None,
        "bands": [_band(b) for b in inputs.bands],
        "differences": [
            {
                "name": name,
                "unit": "pix",
                "pixels_of": inputs.names[0],
                "max": v.length_max,
                "position_of_max": v.position_of_max,
            }
            for name, v in inputs.differences.items()
        ],
        "tables": {
            name: {
                "unit": inputs.tables[name].unit,
                "rows": [_row(account) for account in row_accounts],
            }
            for name, row_accounts in inputs.accounts.items()
        },
    }


def _band(b: BandResult) -> Mapping[str, object]:
    c, p = b.correlation, b.partition
    count = b.sums.bins.count
    return {
        "name": b.name,
        "run": b.path,
        "converged": b.converged,
        "reasons": b.reasons,
        "order": b.order,
        "arcsec_per_pixel": b.arcsec,
        "n_pairs": b.n_pairs,
        "n_used": b.n_used,
        "vectors": {
            "unit": "pix",
            "max": b.vectors.length_max,
            "position_of_max": b.vectors.position_of_max,
        },
        "formal_radius": {
            "unit": b.formal_map.unit,
            "least_squares": b.formal_map.radius_max,
            "posterior": b.posterior_map.radius_max,
        },
        "partition": {
            "blocks": p.k,
            "p_value": p.p_value,
            "significant": p.significant,
            "edges_seen": p.edges_seen,
            "rms_x": p.rms[0],
            "rms_y": p.rms[1],
            "unit": "pix",
            "sentence": p.sentence,
        },
        "correlation": {
            "unit": "pix2",
            "p_value": c.p_value,
            "chi2": c.chi2,
            "reach": c.reach,
            "separation": c.separation,
            "xx": c.uu,
            "yy": c.vv,
            "xy": c.uv,
            "sigma_xx": c.sigma_uu,
            "sigma_yy": c.sigma_vv,
            "sigma_xy": c.sigma_uv,
        },
        "histograms": {case: _histogram(h) for case, h in b.sums.histograms.items()},
        "coverage": {
            "expected": count.mean(),
            "poisson_error": np.sqrt(count.mean()),
            "min": count.min(),
            "max": count.max(),
            "chi2": b.coverage_chi2,
            "dof": count.size - 1,
        },
        "minus_optical_max": None if b.minus_optical is None else b.minus_optical.length_max,
        "printed": None if b.printed is None else asdict(b.printed),
    }


def _histogram(h: ResidualHistogram) -> Mapping[str, object]:
    return {
        "unit": "pix",
        "reach": h.reach,
        "n": h.n,
        "outside_x": h.outside[0],
        "outside_y": h.outside[1],
        "half_width_x": h.half_width()[0],
        "half_width_y": h.half_width()[1],
        "counts_x": h.counts[0],
        "counts_y": h.counts[1],
    }


def _row(one: RowAccount) -> Mapping[str, object]:
    row = one.row
    out: dict[str, object] = {
        "label": row.label,
        "value": row.value,
        "error": row.error,
        "noise_free": row.noise_free,
        "sigma_noise": row.sigma_noise,
        "sigma_partition": one.partition,
        "sigma_rest": one.rest,
        "n_bins": row.n_bins,
    }
    if one.printed is not None:
        out |= {
            "printed": one.printed.value,
            "printed_noise": one.printed_noise,
            "printed_structure": one.printed_structure,
            "printed_more": one.remains,
            "verdict": one.verdict,
            "account": one.sentence,
            "contradictions": one.contradictions,
        }
    return out


def write_tables(inputs: BandsInput, folder: Path) -> tuple[str, ...]:
    """Write the residual tables as table_5_1.ecsv etc.; returns their names.

    Raises InputError if a file cannot be written.
    """
    names = []
    for name, table in inputs.tables.items():
        out = table.to_table(errors=True)
        accounts = inputs.accounts[name]
        _add(out, "Sigma partition", [account.partition for account in accounts], table.unit)
        _add(out, "Sigma rest", [account.rest for account in accounts], table.unit)
        if any(account.printed is not None for account in accounts):
            for statistic, head in HEADS.items():
                values = [
                    None if account.printed is None else account.printed.value[statistic]
                    for account in accounts
                ]
                _add(out, f"{head} printed", values, table.unit)
            for k, limit in enumerate(("least", "most")):
                values = [
                    None if account.printed_noise is None else account.printed_noise[k]
                    for account in accounts
                ]
                _add(out, f"Sigma printed noise, {limit}", values, table.unit)
            _add(out, "Sigma printed more", [account.remains for account in accounts], table.unit)
            out["Account"] = [account.sentence for account in accounts]
            out["Contradictions"] = [" ".join(account.contradictions) for account in accounts]
        out.meta |= {"converged": not inputs.provisional, "bins": inputs.n_bins}
        path = f"table_{name.replace('-', '_')}.ecsv"
        write_table(out, folder / path)
        names.append(path)
    return tuple(names)


def _add(table: Table, name: str, values: list[float | None], unit: str) -> None:
    table[name] = np.array([np.nan if v is None else v for v in values], float)
    table[name].unit = unit
