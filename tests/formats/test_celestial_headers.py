"""Headers of every kind are read as astropy.wcs reads them, or refused."""

from __future__ import annotations

import itertools
import warnings
from pathlib import Path

import astropy.wcs
import numpy as np
import pytest
from astropy.coordinates import SkyCoord
from astropy.io import fits
from astropy.wcs import WCS

import bayesdist as bd
from bayesdist.errors import InputError
from bayesdist.products.common.document import MissingSizeError
from tests.app.support import good

SIZE = (400, 300)
LIMIT_MAS = 0.01
SCALE = 2e-4  # degrees in a pixel
UNITS = {"deg": 1.0, "arcsec": 3600.0, "rad": np.pi / 180, "arcmin": 60.0}
ASTROPY_DATA = Path(astropy.wcs.__file__).parent / "tests" / "data"

POLES = {
    "default": {},
    "lonpole 90": {"LONPOLE": 90.0},
    "lonpole 213": {"LONPOLE": 213.0, "LATPOLE": 10.0},
    "at the pole": {"latitude": 90.0},
    "at the south pole": {"latitude": -90.0},
    "lonpole by PV": {"PV1_3": 150.0},
}
SKEWED = np.array([[-0.9, 0.2], [0.25, 1.1]]) * SCALE


def _linear(form: str, first: float, second: float) -> dict[str, float]:
    """Cards of the linear part, with the number of units in a degree of each axis."""
    scaled = SKEWED * np.array([[first], [second]])
    names = ("1_1", "1_2", "2_1", "2_2")
    cd = {f"CD{n}": float(v) for n, v in zip(names, scaled.flat, strict=True)}
    cdelt = {"CDELT1": -SCALE * first, "CDELT2": 1.2 * SCALE * second}
    pc = dict(zip((f"PC{n}" for n in names), (0.9, -0.3, 0.25, 1.0), strict=True))
    return {
        "CD": cd,
        "PC": {**pc, **cdelt},
        "CDELT": cdelt,
        "CROTA": {**cdelt, "CROTA2": 35.0},
        "PC beside CROTA": {**pc, **cdelt, "CROTA2": 35.0},
        "CD beside CDELT": {**cd, **cdelt},
    }[form]


def _header(
    distortion: str,
    projection: str = "TAN",
    system: str = "RA",
    unit: str = "deg",
    pole: str = "default",
    linear: str = "CD",
    swapped: bool = False,
) -> fits.Header:
    pair = {"RA": ("RA--", "DEC-"), "G": ("GLON", "GLAT"), "E": ("ELON", "ELAT"),
            "H": ("HPLN", "HPLT")}[system]  # fmt: skip
    cards = dict(POLES[pole])
    place = [150.1, cards.pop("latitude", 2.2)]
    code = "TPV" if distortion == "TPV" and projection == "TAN" else projection
    suffix = "-SIP" if distortion == "SIP" else ""
    types = [f"{name}-{code}{suffix}" for name in pair]
    factor = UNITS[unit]
    place = [value * factor for value in place]
    if swapped:
        types, place = types[::-1], place[::-1]
    header = fits.Header(
        {
            "NAXIS": 2, "NAXIS1": SIZE[0], "NAXIS2": SIZE[1], "CTYPE1": types[0],
            "CTYPE2": types[1], "CUNIT1": unit, "CUNIT2": unit, "CRPIX1": 180.0, "CRPIX2": 160.5,
            "CRVAL1": place[0], "CRVAL2": place[1], **_linear(linear, factor, factor), **cards,
        }
    )  # fmt: skip
    if distortion == "SIP":
        header.update({"A_ORDER": 2, "B_ORDER": 3, "A_2_0": 2e-6, "A_1_1": -1e-6, "B_0_2": 3e-6,
                       "B_2_1": 2e-9})  # fmt: skip
    if distortion == "TPV":
        header.update({"PV1_0": 1e-4, "PV1_1": 1.0, "PV1_4": 0.02, "PV1_7": 0.3, "PV2_1": 1.0,
                       "PV2_2": 2e-3, "PV2_5": -0.05})  # fmt: skip
    return header


def _write(header: fits.Header, distortion: str, folder: Path) -> Path:
    if distortion != "CPDIS":
        path = folder / "image.hdr"
        path.write_text(header.tostring(sep="\n", padding=False, endcard=False))
        return path
    path = folder / "image.fits"
    image = fits.PrimaryHDU(np.zeros(SIZE[::-1], np.uint8), header)
    tables = []
    y, x = np.mgrid[0:4, 0:5]
    for axis in (1, 2):
        image.header[f"CPDIS{axis}"] = "LOOKUP"
        for record in (f"EXTVER: {axis}", "NAXES: 2", "AXIS.1: 1", "AXIS.2: 2"):
            image.header.append(fits.Card(f"DP{axis}", record), end=True)
        table = fits.ImageHDU((0.3 * np.sin(x + axis * y)).astype(np.float32), name="WCSDVARR")
        table.ver = axis
        table.header.update({"CRPIX1": 1.0, "CRPIX2": 1.0, "CRVAL1": 1.0, "CRVAL2": 1.0,
                             "CDELT1": 100.0, "CDELT2": 100.0})  # fmt: skip
        tables.append(table)
    fits.HDUList([image, *tables]).writeto(path)
    return path


def _reference(path: Path, x: np.ndarray, y: np.ndarray, without: tuple[str, ...] = ()) -> SkyCoord:
    """Positions in the equatorial system by astropy.wcs of 0-based pixels."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        if path.name.endswith((".fits", ".fits.gz")):
            with fits.open(path) as file:
                hdu = next(h for h in file if "A_ORDER" in h.header or "CPDIS1" in h.header)
                cards = [
                    c for c in hdu.header.cards if not (without and c.image.startswith(without))
                ]
                header = fits.Header(cards)
                wcs = WCS(header, None if without else file)
        else:
            text = path.read_text("latin-1")
            header = fits.Header.fromstring(text, sep="\n" if "\n" in text.strip() else "")
            wcs = WCS(header)
        world = wcs.all_pix2world(np.column_stack([x, y]), 0)
    lon, lat = world[:, wcs.wcs.lng], world[:, wcs.wcs.lat]
    if wcs.wcs.lngtyp == "GLON":
        return SkyCoord(lon, lat, unit="deg", frame="galactic").icrs
    assert wcs.wcs.lngtyp == "RA"
    return SkyCoord(lon, lat, unit="deg")


def _worst_mas(calibration: bd.Calibration, reference: SkyCoord, x, y) -> float:
    ra, dec = calibration.wcs().pixel_to_world_values(x, y)
    return float(SkyCoord(ra, dec, unit="deg").separation(reference).mas.max())


def _grid(size: tuple[float, float], n: int = 9) -> tuple[np.ndarray, np.ndarray]:
    x, y = np.meshgrid(np.linspace(0, size[0] - 1, n), np.linspace(0, size[1] - 1, n))
    return x.ravel(), y.ravel()


HELD = [
    *({"pole": pole, "swapped": swapped} for pole in POLES for swapped in (False, True)
      if not (swapped and pole == "lonpole by PV")),
    *({"unit": unit, "linear": linear, "pole": "lonpole 213"} for unit, linear in
      itertools.product(UNITS, ("CD", "PC", "CDELT", "CROTA", "PC beside CROTA",
                                "CD beside CDELT"))),
    *({"system": "G", "pole": pole, "unit": unit} for pole in ("default", "lonpole 90")
      for unit in ("deg", "arcsec")),
]  # fmt: skip


@pytest.mark.parametrize("distortion", ["SIP", "TPV", "CPDIS"])
def test_tangent_planes_of_any_form_are_read_as_astropy_reads_them(tmp_path, distortion):
    """Over all units, poles, axis orders and forms of the linear part: 0.01 mas or a refusal."""
    x, y = _grid(SIZE)
    read = 0
    for k, options in enumerate(HELD):
        folder = tmp_path / str(k)
        folder.mkdir()
        path = _write(_header(distortion, **options), distortion, folder)
        try:
            calibration = bd.read_calibration(path)
        except InputError:
            assert _may_be_refused(distortion, options), options
            continue
        assert calibration.plane.kind == "sky"
        assert _worst_mas(calibration, _reference(path, x, y), x, y) < LIMIT_MAS, options
        read += 1
    assert read >= sum(not _may_be_refused(distortion, options) for options in HELD)


def _may_be_refused(distortion: str, options: dict[str, object]) -> bool:
    """PV that is no distortion; for TPV, declination first, and PV that wcslib scales by CDELT."""
    if "PV" in str(options.get("pole")):
        return True
    by_cd = options.get("linear", "CD") in ("CD", "CD beside CDELT")
    scaled = not by_cd or options.get("unit", "deg") != "deg"
    return distortion == "TPV" and (scaled or bool(options.get("swapped")))


@pytest.mark.parametrize(
    ("options", "words"),
    [
        *(({"projection": code}, f"an? {code} projection") for code in ("ZEA", "ARC", "STG", "SIN",
                                                                      "ZPN", "CAR", "AIT")),
        ({"projection": "TNX"}, "a TNX of IRAF"),
        ({"projection": "ZPX"}, "a ZPX of IRAF"),
        ({"system": "E"}, "ecliptic coordinates"),
        ({"system": "H"}, "helioprojective coordinates"),
    ],
)  # fmt: skip
def test_other_projections_and_systems_are_refused(tmp_path, options, words):
    path = _write(_header("SIP", **options), "SIP", tmp_path)
    with pytest.raises(InputError, match=words) as caught:
        bd.read_calibration(path)
    assert "astropy.wcs" in str(caught.value)
    if "projection" in options:  # the same without a distortion, and with tables no sky
        plain = _header("", **options)
        with pytest.raises(InputError, match=words):
            bd.read_calibration(_write(plain, "", tmp_path))
        assert bd.read_calibration(
            _write(_header("CPDIS", **options), "CPDIS", tmp_path)
        ).plane.kind == "free"  # fmt: skip


@pytest.mark.parametrize(
    ("radesys", "equinox"), [("FK4", 1950.0), ("FK5", 1975.0), ("GAPPT", 2000.0)]
)
def test_other_equatorial_systems_are_refused(tmp_path, radesys, equinox):
    header = _header("SIP")
    header.update({"RADESYS": radesys, "EQUINOX": equinox})
    with pytest.raises(InputError, match=f"declination of {radesys}"):
        bd.read_calibration(_write(header, "SIP", tmp_path))


@pytest.mark.parametrize("more", [{}, {"CRVAL1": 1.0, "CRVAL2": 2.0}])
def test_a_plate_of_the_digitized_sky_survey_is_named(tmp_path, more):
    header = fits.Header({"NAXIS": 2, "NAXIS1": 100, "NAXIS2": 100, **more,
                          "PLTRAH": 1, "AMDX1": 67.0, "AMDY1": 67.0})  # fmt: skip
    with pytest.raises(InputError, match="Digitized Sky Survey"):
        bd.read_calibration(_write(header, "", tmp_path))


def test_sip_beside_pv_is_read_as_astropy_reads_it_or_refused(tmp_path):
    x, y = _grid(SIZE)
    for distortion, extra in (("SIP", _header("TPV")), ("TPV", _header("SIP"))):
        header = _header(distortion)
        header.update({k: v for k, v in extra.items() if k.startswith(("PV", "A_", "B_"))})
        path = _write(header, distortion, tmp_path)
        try:
            calibration = bd.read_calibration(path)
        except InputError:
            continue
        assert _worst_mas(calibration, _reference(path, x, y), x, y) < LIMIT_MAS


def _with_a_size(path):
    """Calibration of a header; one that states no size is given one."""
    try:
        return bd.read_calibration(path)
    except MissingSizeError:
        return bd.read_calibration(path, size=SIZE)


def test_headers_of_astropy_itself_are_read_alike_or_refused():
    files = [f for f in sorted(ASTROPY_DATA.glob("*")) if f.name.endswith((".hdr", ".fits", ".gz"))]
    assert len(files) > 20
    read = 0
    for path in files:
        try:
            calibration = _with_a_size(path)
        except InputError:
            continue
        without = ("D2IM", "CPDIS", "CPERR", "DP1", "DP2")
        noted = any("without the look-up tables" in note for note in calibration.notes)
        x, y = _grid(calibration.model.chips[0].size)
        reference = _reference(path, x, y, without if noted else ())
        assert _worst_mas(calibration, reference, x, y) < LIMIT_MAS, path.name
        read += 1
    assert read >= 8


def test_a_converted_header_has_the_same_positions(tmp_path):
    """From arcsec, exchanged axes, LONPOLE and galactic coordinates to TPV, by astropy.wcs."""
    x, y = _grid(SIZE)
    for k, options in enumerate(({"unit": "arcsec", "swapped": True, "pole": "lonpole 90"},
                                 {"system": "G", "linear": "PC beside CROTA"})):  # fmt: skip
        path = _write(_header("SIP", **options), "SIP", tmp_path)
        out = tmp_path / f"{k}.head"
        good("convert", path, "--to", "tpv", "-o", out)
        header = fits.Header.fromtextfile(out)
        reference = _reference(path, x, y)
        made = SkyCoord(*WCS(header).all_pix2world(x, y, 0), unit="deg")
        assert made.separation(reference).mas.max() < LIMIT_MAS
