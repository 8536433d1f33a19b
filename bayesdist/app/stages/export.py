"""Stage 4: files for pipelines."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from typing import Any

from bayesdist.app.session import Session
from bayesdist.assess.solution import Solution
from bayesdist.products import (
    IdcTab,
    SipHeader,
    idctab_from_solution,
    lint_idctab,
    lint_sip,
    lint_wise_band,
    read_idctab,
    read_sip,
    read_wise_meta,
    sip_from_solution,
    write_idctab,
    write_sip,
    write_wise_meta,
)
from bayesdist.products.sip import SIP_ORDERS

__all__ = ["idctab_of", "run_export", "sip_of", "wise_sip_of"]

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
            products.append(
                {
                    "path": path.name,
                    "kind": "SIP",
                    "chip": chip.number,
                    "closure_pix": header.closure,
                    "a_dmax": header.a_dmax,
                    "b_dmax": header.b_dmax,
                    "findings": [f"{f.level}: {f.where}: {f.message}" for f in findings],
                }
            )
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
    run.summarise(products=products)
    log.info("export: %s", ", ".join(p["path"] for p in products) or "no products asked for")


def sip_of(session: Session, solution: Solution, chip: int) -> SipHeader:
    sip = session.config.products.sip
    assert sip is not None
    return sip_from_solution(
        solution,
        chip=chip,
        epoch=session.epoch,
        inverse_order=sip.inverse_order,
        linear=sip.linear,
        crval=sip.crval,
        scale_arcsec=session.scale_arcsec,
    )


def wise_sip_of(session: Session, solution: Solution) -> SipHeader:
    """As WISE has it: all linear terms in A and B, and an inverse of the same order."""
    return sip_from_solution(
        solution,
        epoch=session.epoch,
        inverse_order=max(solution.model.order, SIP_ORDERS[0]),
        linear="sip",
        scale_arcsec=session.scale_arcsec,
    )


def idctab_of(session: Session, solution: Solution) -> IdcTab:
    idc = session.config.products.idctab
    assert idc is not None
    return idctab_from_solution(
        solution, scale_arcsec=session.scale_arcsec, **idc.model_dump(exclude_none=True)
    )
