"""Columns of quantities, found by the user's names or by the names and units of known programs."""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Mapping
from typing import Any

from bayesdist.errors import InputError

NO_MOTION = "no proper motion"  # reason for which stars without a motion are left out
ASSUMED = "assumed_motion"  # quantity that is 1 for stars without a measured motion
# lower case; the first name that the file has is used, and for a pair the first that both have
BASIC: dict[str, tuple[str, ...]] = {
    "x": ("x", "x_pix", "xpix", "x_raw", "xraw", "xwin_image", "xpsf_image", "x_image"),
    "y": ("y", "y_pix", "ypix", "y_raw", "yraw", "ywin_image", "ypsf_image", "y_image"),
    "u": ("u",),
    "v": ("v",),
    "sigma_u": ("sigma_u", "su", "sig_u", "u_error", "u_err", "u_sigma", "e_u", "err_u", "sigma"),
    "sigma_v": ("sigma_v", "sv", "sig_v", "v_error", "v_err", "v_sigma", "e_v", "err_v", "sigma"),
    "epoch": ("epoch", "year"),
    "exposure": ("exposure", "exp", "frame", "exposure_name"),
    "chip": ("chip", "ccdchip", "ccd_chip"),
    "mag": ("mag", "magnitude"),
    "star": ("star",),
}

ALIASES: dict[str, tuple[str, ...]] = {
    "x": (
        *BASIC["x"],
        *("xcentroid", "x_centroid", "x_fit", "xcenter", "slot_centroid_x"),
        *("pixel_centroid_x", "x_psf"),
        *("base_sdsscentroid_x", "w1x", "w2x", "w3x", "w4x"),
    ),
    "y": (
        *BASIC["y"],
        *("ycentroid", "y_centroid", "y_fit", "ycenter", "slot_centroid_y"),
        *("pixel_centroid_y", "y_psf"),
        *("base_sdsscentroid_y", "w1y", "w2y", "w3y", "w4y"),
    ),
    "u": ("u", "xi"),
    "v": ("v", "eta"),
    "ra": (
        *("ra", "ra_deg", "radeg", "ra_icrs", "raj2000", "_raj2000", "ra_j2000", "alpha_j2000"),
        *("alphawin_j2000", "alphapsf_j2000", "coord_ra", "right_ascension", "alpha"),
        *("skycoord.ra", "sky_centroid.ra", "coord.ra", "sky.ra"),
    ),
    "dec": (
        *("dec", "dec_deg", "decdeg", "de_icrs", "dej2000", "_dej2000", "dec_j2000"),
        *("delta_j2000", "deltawin_j2000", "deltapsf_j2000", "coord_dec", "declination", "delta"),
        *("skycoord.dec", "sky_centroid.dec", "coord.dec", "sky.dec"),
    ),
    "sigma_u": (*BASIC["sigma_u"], "xi_error", "xi_err", "sigma_xi", "e_xi"),
    "sigma_v": (*BASIC["sigma_v"], "eta_error", "eta_err", "sigma_eta", "e_eta"),
    "sigma_x": (
        *("sigma_x", "x_err", "xerr", "x_error", "e_x", "xcentroid_err", "x_centroid_err"),
        *("x_fit_err", "x_psf_err", "x_centroid_win_err", "slot_centroid_xerr"),
        *("errx2win_image", "errx2psf_image", "errx2_image"),
    ),
    "sigma_y": (
        *("sigma_y", "y_err", "yerr", "y_error", "e_y", "ycentroid_err", "y_centroid_err"),
        *("y_fit_err", "y_psf_err", "y_centroid_win_err", "slot_centroid_yerr"),
        *("erry2win_image", "erry2psf_image", "erry2_image"),
    ),
    "rho_xy": ("rho_xy", "corr_xy", "errxywin_image", "errxypsf_image", "errxy_image"),
    "rho_uv": ("rho_uv", "corr_uv", "uv_corr"),
    "sigma_ra": ("ra_error", "e_ra_icrs", "sigra"),
    "sigma_dec": ("dec_error", "e_de_icrs", "sigdec"),
    "pm_ra": ("pmra", "pmra"),
    "pm_dec": ("pmdec", "pmde"),
    "sigma_pm_ra": ("pmra_error", "e_pmra"),
    "sigma_pm_dec": ("pmdec_error", "e_pmde"),
    "corr_ra_dec": ("ra_dec_corr", "corr_ra_dec", "radecor"),
    "corr_ra_pm_ra": ("ra_pmra_corr",),
    "corr_ra_pm_dec": ("ra_pmdec_corr",),
    "corr_dec_pm_ra": ("dec_pmra_corr",),
    "corr_dec_pm_dec": ("dec_pmdec_corr",),
    "corr_pm_ra_pm_dec": ("pmra_pmdec_corr",),
    "corr_ra_parallax": ("ra_parallax_corr",),
    "corr_dec_parallax": ("dec_parallax_corr",),
    "corr_parallax_pm_ra": ("parallax_pmra_corr",),
    "corr_parallax_pm_dec": ("parallax_pmdec_corr",),
    "parallax": ("parallax", "plx"),
    "sigma_parallax": ("parallax_error", "e_plx"),
    "catalogue_epoch": ("ref_epoch",),
    "epoch": (*BASIC["epoch"], "mjd", "mjd_obs", "mjd-obs", "obs_mjd", "date_obs", "date-obs"),
    "exposure": (*BASIC["exposure"], "expname", "rootname", "expnum", "visit"),
    "chip": (
        *(*BASIC["chip"], "ccd", "ccdnum", "chip_id", "ccd_id", "detector", "sca", "detpos"),
        "ext_number",
    ),
    "filter": ("filter", "filt", "filter_name", "band"),
    "mag": (
        *(*BASIC["mag"], "mag_psf", "mag_auto", "mag_iso", "mag_best", "mag_fit"),
        *("auto_mag", "mag_data"),
        *("phot_g_mean_mag", "gmag", "w1mpro"),
    ),
    "flux": (
        *("flux", "flux_psf", "flux_auto", "flux_fit", "kron_flux", "segment_flux"),
        *("auto_flux", "psfflux", "instflux", "slot_psfflux_instflux", "base_psfflux_instflux"),
        "aperture_sum",
    ),
    "colour": ("colour", "color", "bp_rp"),
    "star": BASIC["star"],
    ASSUMED: (ASSUMED,),
    "u_nominal": ("u_nominal",),
    "v_nominal": ("v_nominal",),
}

PAIRS = (
    *(("x", "y"), ("u", "v"), ("ra", "dec"), ("sigma_u", "sigma_v"), ("sigma_ra", "sigma_dec")),
    *(("pm_ra", "pm_dec"), ("sigma_pm_ra", "sigma_pm_dec"), ("sigma_x", "sigma_y")),
)

_MAS, _MOTION = "mas", "mas / yr"
# units documented by catalogues; a catalogue is recognised by two further column names
_CATALOGUES: tuple[tuple[dict[str, str], frozenset[str]], ...] = (
    (  # Gaia archive
        {
            **dict.fromkeys(("ra_error", "dec_error", "parallax", "parallax_error"), _MAS),
            **dict.fromkeys(("pmra", "pmdec", "pmra_error", "pmdec_error"), _MOTION),
        },
        frozenset(
            ("source_id", "solution_id", "ref_epoch", "phot_g_mean_mag", "parallax", "pmra",
             "pmra_error", "parallax_error", "ruwe", "bp_rp", "phot_bp_mean_mag")
        ),
    ),
    (  # Gaia as VizieR and the X-match service of CDS have it
        {
            **dict.fromkeys(("e_ra_icrs", "e_de_icrs", "plx", "e_plx"), _MAS),
            **dict.fromkeys(("pmra", "pmde", "e_pmra", "e_pmde"), _MOTION),
        },
        frozenset(
            ("ra_icrs", "e_ra_icrs", "plx", "e_plx", "pmra", "pmde", "gmag", "source", "ruwe")
        ),
    ),
    (  # AllWISE and other source tables of IRSA
        {"sigra": "arcsec", "sigdec": "arcsec"},
        frozenset(("designation", "w1mpro", "w2mpro", "sigradec", "w1x", "source_id")),
    ),
)  # fmt: skip
_COMPANY = 2
_DAYS = frozenset(("mjd", "mjd_obs", "mjd-obs", "obs_mjd"))

# names used only by programs that count pixels from 0
_FROM_ZERO = {
    **dict.fromkeys(("xcentroid", "x_centroid", "x_fit", "x_init"), "photutils"),
    **dict.fromkeys(("xcentroid_win", "xcentroid_quad"), "photutils"),
    **dict.fromkeys(("x_centroid_win", "x_centroid_quad"), "photutils"),
    **dict.fromkeys(("slot_centroid_x", "base_sdsscentroid_x"), "the LSST pipelines"),
}
# program, and columns that it writes together with x, y
_COUNTS_FROM_ZERO: tuple[tuple[str, frozenset[str]], ...] = (
    ("sep", frozenset(("tnpix", "xcpeak"))),
    ("photutils", frozenset(("aperture_sum",))),
    ("the LSST pipelines", frozenset(("coord_ra", "detect_isprimary"))),
    ("the LSST pipelines", frozenset(("coord_ra", "parentsourceid"))),
)
_ORIGIN_KEYS = ("pixel_origin", "pixorig", "pix_orig")


def find_columns(
    names: Iterable[str],
    mapping: Mapping[str, str] | None,
    aliases: Mapping[str, tuple[str, ...]],
    *,
    source: str,
    pairs: Iterable[tuple[str, str]] = (),
    needed: Iterable[str] = (),
) -> dict[str, str]:
    """Column of each quantity that a file has.

    Parameters
    ----------
    names : iterable of str
        Columns of the file.
    mapping : mapping of str to str or None
        Columns named by the user; an empty name omits the quantity.
    aliases : mapping of str to tuple of str
        Usual column names of each quantity, in lower case.
    source : str
        Name of the file, for error messages.
    pairs : iterable of tuple of str
        Quantities with corresponding aliases; names are preferred for which the file has both.
    needed : iterable of str
        Quantities that the file must have.

    Returns
    -------
    dict of str to str
        Column by quantity.

    Raises
    ------
    InputError
        If a quantity is unknown, if a column is not in the file (the message suggests the nearest
        name), or if a needed quantity is missing.
    """
    names = list(names)
    column_names: dict[str, str] = {}
    for key, column in (mapping or {}).items():
        if key not in aliases:
            raise InputError(
                f"columns has the key {key!r}, which is not a known quantity",
                where=source,
                do=f"use {_nearest(key, aliases)}",
            )
        if column and column not in names:
            raise InputError(
                f"column {column!r} is missing", where=source, do=f"name {_nearest(column, names)}"
            )
        column_names[key] = column
    lower: dict[str, str] = {}
    for name in names:
        # if two columns differ only in case, the one in lower case is used
        if name.lower() not in lower or name == name.lower():
            lower[name.lower()] = name
    for first_key, second_key in pairs:
        if first_key not in column_names and second_key not in column_names:
            alias_pairs = zip(aliases[first_key], aliases[second_key], strict=True)
            first = next((two for two in alias_pairs if lower.keys() >= set(two)), None)
            if first is not None:
                column_names[first_key], column_names[second_key] = lower[first[0]], lower[first[1]]
    for key, usual in aliases.items():
        if key not in column_names:
            column_names[key] = next((lower[a] for a in usual if a in lower), "")
    for key in needed:
        if not column_names[key]:
            raise InputError(
                f"no column for {key!r} among {', '.join(names) or 'none'}",
                where=source,
                do="rename the column, or name it with the option 'columns'",
            )
    return {key: column for key, column in column_names.items() if column}


def _nearest(name: str, choices: Iterable[str]) -> str:
    """The nearest choice, or a list of all choices if none is near."""
    choices = list(choices)
    lower = {c.lower(): c for c in choices}
    near = difflib.get_close_matches(name.lower(), lower, n=1, cutoff=0.5)
    if near:
        return f"{lower[near[0]]!r} if that is meant"
    return "one of " + ", ".join(repr(c) for c in choices)


def known_unit(name: str, names: Iterable[str]) -> str | None:
    """Unit implied by the name of a column if its file states none; None if unknown.

    A catalogue is recognised by two of its column names in addition to this one.
    """
    name, lower_names = name.lower(), {label.lower() for label in names}
    if name in _DAYS:
        return "d"
    for units, company in _CATALOGUES:
        if name in units and len((company & lower_names) - {name}) >= _COMPANY:
            return units[name]
    return None


def origin_of(column: str, names: Iterable[str], header: Mapping[str, Any]) -> tuple[int, str]:
    """Coordinate (0 or 1) of the centre of the first pixel, and the reason.

    `column` is the column of x.  If nothing is known, the reason is empty and the coordinate is 1,
    the FITS convention.
    """
    for key, value in header.items():
        if str(key).lower() in _ORIGIN_KEYS and str(value).strip() in ("0", "1"):
            return int(str(value).strip()), f"{key} in the header"
    programs = str(header.get("version", "")) + " ".join(map(str, header))
    if "photutils" in programs.lower():
        return 0, "photutils in the header, which counts from 0"
    lower = {name.lower() for name in names}
    if column.lower() in _FROM_ZERO:
        return 0, f"{column} is a name of {_FROM_ZERO[column.lower()]}, which counts from 0"
    if column in ("x", "xcenter"):
        for program, companions in _COUNTS_FROM_ZERO:
            if companions <= lower:
                return 0, f"{', '.join(sorted(companions))} are of {program}, which counts from 0"
    return 1, ""
