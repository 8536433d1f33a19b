"""Stage 4 of a campaign: the files that a pipeline takes in."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

from bayesdist.app.campaign.session import CampaignSession
from bayesdist.assess.solution import Solution
from bayesdist.infer.views import reference_gauge, without_frames
from bayesdist.products import (
    Period,
    lint_idctab,
    lint_lookup_file,
    orientation_from_idctab,
    read_idctab,
    read_lookup_file,
    write_release,
)

__all__ = ["release"]


def release(session: CampaignSession, solution: Solution) -> list[dict[str, Any]]:
    """Write IDCTABs, D2IMFILE and NPOLFILE, and say what was written.

    Parameters
    ----------
    session : CampaignSession
    solution : LinearFit or Posterior

    Returns
    -------
    list of dict
        Entries of summary.json.
    """
    block = session.config.products.release
    assert block is not None
    filter = session.block.filter or session.inputs.log.filters[0]
    number = session.reference_chip
    view = reference_gauge(without_frames(solution), number)
    time = view.model.time
    orientation = orientation_from_idctab(
        view,
        read_idctab(session.base / block.reference),
        chip=number,
        epoch=None if time is None else time.epoch0[0],
        scale_arcsec=block.scale_arcsec,
    )
    written = write_release(
        session.run.path,
        block.name,
        {filter: view},
        orientation,
        [Period(**one.model_dump()) for one in block.period],
        tables=session.tables,
        instrument=block.instrument,
        detector=block.detector,
        scale_arcsec=block.scale_arcsec,
        limit_mas=block.limit_mas,
    )
    out: list[dict[str, Any]] = []
    for period, path in written.idctabs.items():
        findings = lint_idctab(read_idctab(path))
        lost = [asdict(one) for one in written.lost.get(period, ())]
        out.append(_entry(path.name, "IDCTAB", findings) | {"period": period, "lost": lost})
    others = [] if written.d2im is None else [("D2IMFILE", written.d2im)]
    for kind, path in [*others, *(("NPOLFILE", p) for p in written.npol.values())]:
        out.append(_entry(path.name, kind, lint_lookup_file(read_lookup_file(path))))
    return out


def _entry(path: str, kind: str, findings: Any) -> dict[str, Any]:
    said = [f"{f.level}: {f.where}: {f.message}" for f in findings]
    return {"path": path, "kind": kind, "findings": said}
