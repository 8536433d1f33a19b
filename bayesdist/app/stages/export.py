"""Stage 4: files for pipelines."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from typing import Any

from bayesdist.app.made_files import idctab_of, sip_of, wise_sip_of
from bayesdist.app.session import Session
from bayesdist.app.sky_closure import sky_closure
from bayesdist.assess.product_terms import PRODUCT, with_product
from bayesdist.products import (
    lint_idctab,
    lint_sip,
    lint_wise_band,
    read_idctab,
    read_sip,
    read_wise_meta,
    write_idctab,
    write_sip,
    write_wise_meta,
)

__all__ = ["run_export"]

NOTICED = 0.3  # of the total error: it makes that 4 % larger

log = logging.getLogger("bayesdist")


def run_export(session: Session, written: Sequence[dict[str, Any]] = ()) -> None:
    """Write what the configuration asks for; `written` is what there is already."""
    config, run = session.config, session.run
    products: list[dict[str, Any]] = [*written]
    if config.products.sip is not None:
        for chip in session.solution.model.chips:
            several = len(session.solution.model.chips) > 1
            path = run / (f"sip_{chip.number}.hdr" if several else "sip.hdr")
            header = sip_of(session, session.solution, chip.number)
            write_sip(header, path)
            findings = lint_sip(read_sip(path), size=chip.size)
            sky = sky_closure(session, path, chip.number)
            products.append(
                {
                    "path": path.name,
                    "kind": "SIP",
                    "chip": chip.number,
                    "closure_pix": header.closure,
                    "a_dmax": header.a_dmax,
                    "b_dmax": header.b_dmax,
                    **({} if sky is None else {"sky": sky.summary}),
                    "findings": [f"{f.level}: {f.where}: {f.message}" for f in findings],
                }
            )
            if sky is not None:
                log.log(sky.level, "export: %s: %s", path.name, sky.sentence)
                products[-1]["findings"] += sky.findings
    idc = config.products.idctab
    if idc is not None:
        path = run / f"{idc.instrument}_{idc.detector}_idc.fits".lower()
        write_idctab(idctab_of(session, session.solution), path)
        findings = lint_idctab(read_idctab(path))
        products.append(
            {
                "path": path.name,
                "kind": "IDCTAB",
                "findings": [f"{f.level}: {f.where}: {f.message}" for f in findings],
            }
        )
    if config.wise_band is not None and config.products.wise_meta:
        path = run / f"w{config.wise_band}.meta"
        write_wise_meta(path, {config.wise_band: wise_sip_of(session, session.solution)})
        [band] = read_wise_meta(path)
        products.append(
            {
                "path": path.name,
                "kind": "WISE meta-data",
                "closure_pix": band.sip.closure,
                "a_dmax": band.sip.a_dmax,
                "b_dmax": band.sip.b_dmax,
                "findings": [f"{f.level}: {f.where}: {f.message}" for f in lint_wise_band(band)],
            }
        )
    for product in products:
        _compare(product, run.summary.get("budget", []))
    run.summarise(products=products)
    log.info("export: %s", ", ".join(p["path"] for p in products) or "no products asked for")


def _compare(product: dict[str, Any], budget: Sequence[dict[str, Any]]) -> None:
    """Note what the budget says of a file, and what the total is for whoever uses it."""
    for row in budget:
        files, _, direction = row["name"].rpartition(", ")
        path = product["path"]
        if row["kind"] != PRODUCT or not (
            path in files.split(", ") or path.startswith(f"{files}_")
        ):
            continue
        product[f"{direction}_rms"] = row["radial"]
        total = budget[-1]["radial"]
        if direction == "forward":
            product["total_rms"] = with_product(total, row["radial"])
            if row["radial"] > NOTICED * total:
                product["findings"].append(
                    f"warning: forward: differs from the solution by {row['radial']:.2g} rms over "
                    f"the detector, whose total error is {total:.2g}"
                )
