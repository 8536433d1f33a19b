"""Calibration files of a solution as the configuration asks for them, not yet written."""

from __future__ import annotations

from bayesdist.app.session import Session
from bayesdist.assess.solution import Solution
from bayesdist.products import IdcTab, SipHeader, idctab_from_solution, sip_from_solution
from bayesdist.products.formats.sip.header import SIP_ORDERS

__all__ = ["idctab_of", "sip_of", "wise_sip_of"]


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
        tangent_point=session.tangent_point,
        scale_arcsec=session.scale_arcsec,
        notes=[*_notes(session), *_sky_notes(session)],
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
        solution,
        scale_arcsec=session.scale_arcsec,
        history=_notes(session),
        **idc.model_dump(exclude_none=True),
    )


def _notes(session: Session) -> list[str]:
    """What a file has to say of the run it is from."""
    return [session.gauge_words] if session.gauge_words else []


def _sky_notes(session: Session) -> list[str]:
    """For which exposure a header is right on the sky, where they differ."""
    model = session.model
    if session.tangent_point is None or model.frames == "none" or len(model.exposures) < 2:
        return []
    return [f"On the sky it is exposure {model.exposures[0]}: others have frames of their own."]
