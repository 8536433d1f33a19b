"""The released set of files: several filters, two periods, tables; judged by stwcs."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from astropy.io import fits
from numpy.testing import assert_allclose

from bayesdist.calibration.calibration import calibration_of
from bayesdist.calibration.plane import Orientation
from bayesdist.errors import InputError
from bayesdist.formats.idctab.build import idctab_from_solution
from bayesdist.formats.idctab.drift import storable
from bayesdist.formats.idctab.lint import lint_idctab
from bayesdist.formats.idctab.table import combination_of, read_idctab
from bayesdist.infer.solution.solution import GaussianSolution
from bayesdist.infer.solution.transforms import reference_gauge
from bayesdist.missions.hst.release import Period, Release, write_release
from bayesdist.missions.hst.simulate import acs_solution
from bayesdist.missions.hst.simulate.making import detector_tables, filter_tables
from bayesdist.model.lookup import LookupTable, corrected
from tests.reduced import case_in_full

from ...formats.acs_offline import Pointing, to_sky
from ...formats.acs_offline import corrected as corrected_by_stwcs
from ...formats.stwcs_offline import separation_mas
from ...formats.support import StandIn, laid_on, random_pixels, some_covariance, turned_by

ACS = {"instrument": "ACS", "detector": "WFC"}
PERIODS = (
    Period("pre", (2002.2, 2009.4), 0, "Mar 01 2002 00:00:00", "INFLIGHT 01/03/2002 01/05/2009"),
    Period("post", (2009.4, 2015.0), 1, "Jun 01 2009 00:00:00", "INFLIGHT 01/06/2009 31/12/2014"),
)


def solution_of(filter: str, seed: int) -> StandIn:
    model, theta = acs_solution(filter)
    return StandIn(model, theta, some_covariance(theta.size, 1e-3, np.random.default_rng(seed)))


def calibrations(solutions):
    return {filter: calibration_of(one) for filter, one in solutions.items()}


@pytest.fixture(scope="module")
def solutions() -> dict[str, StandIn]:
    return {"F606W": solution_of("F606W", 1), "F814W": solution_of("F814W", 2)}


@pytest.fixture(scope="module")
def tables() -> tuple[LookupTable, ...]:
    rng = np.random.default_rng(3)
    return (
        *detector_tables(rng),
        *filter_tables("F606W", rng),
        *filter_tables("F814W", rng),
    )


def reference_of(solution: StandIn):
    """A table made by hand that differs from the solution by a similarity and some mas."""
    rng = np.random.default_rng(4)
    model = replace(solution.model, unit="arcsec", time=None)
    theta = np.empty(model.n_params)
    for chip in (1, 2):
        u, v = (model.coefficient_slice(chip, axis) for axis in (0, 1))
        w = 0.05 * np.exp(-1j * np.deg2rad(2.2336)) * (solution.mean[u] + 1j * solution.mean[v])
        w = w + rng.normal(scale=1e-3, size=(len(w), 2)) @ [1, 1j]
        theta[u], theta[v] = w.real, w.imag
    made = StandIn(model, theta, 1e-12 * np.eye(theta.size))
    return idctab_from_solution(made, **ACS, v2ref=256.602, v3ref=302.252)


@pytest.fixture(scope="module")
def orientation(solutions) -> Orientation:
    return laid_on(
        solutions["F606W"], reference_of(solutions["F606W"]), epoch=2004.5,
        reference_drift=False, scale_arcsec=0.05,
    )  # fmt: skip


@pytest.fixture(scope="module")
def release(tmp_path_factory, solutions, orientation, tables) -> Release:
    return write_release(
        tmp_path_factory.mktemp("release") / "new",
        "acs", calibrations(solutions), orientation, PERIODS,
        tables=tables, stand_ins={"F555W": "F606W", ("CLEAR1L", "CLEAR2L"): "F606W"},
        history=["Simulated campaign."],
    )  # fmt: skip


# -- stwcs as the judge ---------------------------------------------------------------------------


@dataclass(frozen=True)
class Sky:
    """What our model makes of pixels, on the sky that stwcs has for a pointing."""

    solution: StandIn
    filter: str
    orientation: Orientation
    tables: tuple[LookupTable, ...]
    pointing: Pointing

    def at(self, x, y, chip: int, *, tables: bool = True) -> np.ndarray:
        turned = turned_by(self.solution, self.orientation)
        epoch = self.pointing.epoch
        [centre] = turned.model.predict(turned.solution.mean, 2048.0, 1024.0, epoch=epoch, chip=2)
        v2v3 = self.orientation.v2v3[0] + centre[0], self.orientation.v2v3[1] - centre[1]
        if tables:
            x, y = corrected(self.tables, x, y, chip=chip, filter=self.filter)
        plane = turned.model.predict(turned.solution.mean, x, y, epoch=epoch, chip=chip)
        return to_sky(plane - centre, self.pointing, v2v3)


@pytest.mark.parametrize(
    ("date", "period"),
    [
        *[("2003-01-01", "pre"), ("2014-01-01", "post")],
        *(
            case_in_full(*one, instead="a date of each period is run")
            for one in (("2008-07-01", "pre"), ("2010-01-01", "post"))
        ),
    ],
)
def test_stwcs_sees_the_sky_of_our_model(
    date, period, release, solutions, orientation, tables, tmp_path
) -> None:
    """IDCTAB, drift, D2IMFILE and NPOLFILE against the fitted model, nothing left free: 0.1 mas."""
    pytest.importorskip("stwcs")
    pointing = Pointing(date, (5.66, -72.07), 57.3, 1.0000187)
    ours = Sky(solutions["F606W"], "F606W", orientation, tables, pointing)
    wcs = corrected_by_stwcs(
        tmp_path, "one", pointing, idctab=release.idctabs[period], d2im=release.d2im,
        npol=release.npol["F606W"],
    )  # fmt: skip
    x, y = random_pixels((4096, 2048), 300)
    for chip in (1, 2):
        theirs = wcs[chip].all_pix2world(np.stack([x, y], axis=1), 1)
        assert separation_mas(ours.at(x, y, chip), theirs).max() < 0.1
        # the tables are in it: without them the sky is elsewhere
        assert separation_mas(ours.at(x, y, chip, tables=False), theirs).max() > 2


def test_the_other_filter_has_its_own_sky(
    release, solutions, orientation, tables, tmp_path
) -> None:
    """F814W has another scale and another table; the chip offset follows its own solution."""
    pytest.importorskip("stwcs")
    pointing = Pointing("2006-07-01", (80.2, -69.5), 211.0, 0.99995, ("CLEAR1L", "F814W"))
    ours = Sky(solutions["F814W"], "F814W", orientation, tables, pointing)
    wcs = corrected_by_stwcs(
        tmp_path, "two", pointing, idctab=release.idctabs["pre"], d2im=release.d2im,
        npol=release.npol["F814W"],
    )  # fmt: skip
    x, y = random_pixels((4096, 2048), 200)
    for chip in (1, 2):
        theirs = wcs[chip].all_pix2world(np.stack([x, y], axis=1), 1)
        assert separation_mas(ours.at(x, y, chip), theirs).max() < 0.1


# -- what the files hold --------------------------------------------------------------------------


def test_all_files_are_there_and_clean(release) -> None:
    names = [path.name for path in release.paths]
    assert names == [
        "acs_pre_idc.fits", "acs_post_idc.fits", "acs_d2i.fits", "acs_f606w_npl.fits",
        "acs_f814w_npl.fits",
    ]  # fmt: skip
    for path in release.paths:
        with fits.open(path) as hdus:
            hdus.verify("exception")
    for name, path in release.idctabs.items():
        tab = read_idctab(path)
        assert lint_idctab(tab) == ()
        assert tab.tdd["TDD_DATE"] == {"pre": 2004.5, "post": 2012.5}[name]
        keys = {(int(r["DETCHIP"]), r["FILTER1"], r["FILTER2"], r["DIRECTION"]) for r in tab.rows}
        combinations = {
            ("F606W", "CLEAR2L"), ("CLEAR1L", "F814W"), ("F555W", "CLEAR2L"),
            ("CLEAR1L", "CLEAR2L"),
        }  # fmt: skip
        assert keys == {
            (chip, *c, d) for chip in (1, 2) for c in combinations for d in ("FORWARD", "INVERSE")
        }
        history = " ".join(map(str, tab.header["HISTORY"]))
        assert "Simulated campaign." in history and "chip 2 laid on" in history
        assert history.count("Not stored: drift of the u term x^0 y^1") == 4
        assert len(release.lost[name]) == 4
    pre, post = (read_idctab(p) for p in release.idctabs.values())
    # the step at SM4: A_2 changed by 8.4e-5, which CX11 holds in arcsec
    change = float(post.rows["CX11"][0] - pre.rows["CX11"][0])
    assert abs(change) > 3e-6


def test_orientation_is_recorded(release, orientation) -> None:
    header = read_idctab(release.idctabs["pre"]).header
    assert header["BDANGLE"] == pytest.approx(np.rad2deg(orientation.angle))
    assert header["BDANGSIG"] == pytest.approx(np.rad2deg(orientation.sigma["angle"]))
    assert (header["BDSCALE"], header["BDSCASIG"], header["BDUNIT"]) == (0.05, 0.0, "pix")
    assert header["BDV2SIG"] == pytest.approx(orientation.sigma["shift_x"])
    assert header["BDAGRRMS"] == pytest.approx(orientation.agreement.rms)


@pytest.fixture(scope="module")
def tab(release):
    return read_idctab(release.idctabs["pre"])


@pytest.mark.parametrize("filter", ["F606W", "F814W"])
@pytest.mark.parametrize("chip", [1, 2])
def test_inverse_rows_lead_back(tab, chip, filter) -> None:
    """Within the closure that the header states for pixel centres, and that is reached."""
    x, y = random_pixels((4095, 2047), 20_000)
    x, y = x + 0.5, y + 0.5
    Xc, Yc = tab.evaluate(chip, x, y, filter=filter)
    x1, y1 = tab.invert(chip, Xc, Yc, filter=filter)
    left = np.hypot(x1 - x, y1 - y).max()
    stated = tab.header[f"BDCLOS_{chip}"]
    assert 0.5 * stated < left <= stated * 1.01  # of a grid of 16 pixels
    assert stated < 0.01


def test_sigma_of_inverse_rows(solutions, orientation) -> None:
    """Against inverses fitted anew after small steps of the solution."""
    turned = turned_by(solutions["F606W"], orientation)
    base = storable(turned, years=(2002.2, 2009.4))[0].solution

    def rows(solution):
        made = idctab_from_solution({"F606W": solution}, **ACS, scale_arcsec=0.05, inverse=True)
        names = [n for n in made.columns if n[0] == "C"]
        place = made.row(1, "F606W", "INVERSE")
        return (np.array([[t[n][place] for n in names] for t in (made.rows, made.sigma)]), names)

    (values, _), names = rows(base)
    rng = np.random.default_rng(5)
    steps = 1e-6 * rng.normal(size=(3, base.mean.size))
    (_, stated), _ = rows(StandIn(base.model, base.mean, steps.T @ steps))
    moved = [rows(StandIn(base.model, base.mean + s, base.cov))[0][0] - values for s in steps]
    found = np.sqrt(np.sum(np.square(moved), axis=0))
    # to first order in the closure (some 1e-3 px of 1e3): high orders see their own residual
    assert_allclose(found[names.index("CX10")], stated[names.index("CX10")], rtol=1e-2)
    assert np.median(np.abs(found / stated - 1)) < 0.05


def test_covariance_over_filters_by_steps(solutions) -> None:
    """COVAR of both filters and chips, from steps of all that it comes from.

    A step of F606W moves the orientation, and F814W with it; a step of the reference moves both.
    """
    base, other = solutions["F606W"], solutions["F814W"]
    reference = reference_of(base)
    names = {"epoch": 2004.5, "reference_drift": False}

    def made(a, b, error=None):
        o = laid_on(a, reference, **names)
        if error is not None:
            turn = error[2] + 1j * error[3]
            o = replace(
                o, shift=o.shift + error[:2], scale=o.scale * np.exp(turn.real),
                angle=o.angle + turn.imag,
            )  # fmt: skip
        first, _ = storable(turned_by(a, o), years=(2002.2, 2009.4), limit_mas=9.0)
        second, _ = storable(turned_by(b, o), years=(2002.2, 2009.4), like=first, limit_mas=9.0)
        return idctab_from_solution(
            {"F606W": first, "F814W": second}, **ACS, scale_arcsec=0.05
        ).covariance, o

    rng = np.random.default_rng(6)
    steps_a, steps_b = (1e-4 * rng.normal(size=(2, base.mean.size)) for _ in range(2))
    few_a = replace(base, cov=steps_a.T @ steps_a)
    few_b = replace(other, cov=steps_b.T @ steps_b)
    table, o = made(few_a, few_b)
    root = np.linalg.cholesky(o.reference_cov)
    moves = [made(replace(base, mean=base.mean + s), other)[0]["VALUE"] for s in steps_a]
    moves += [made(base, replace(other, mean=other.mean + s))[0]["VALUE"] for s in steps_b]
    moves += [made(base, other, error)[0]["VALUE"] for error in root.T]
    difference = np.array(moves) - table["VALUE"]
    expected = difference.T @ difference
    sd = np.sqrt(np.diag(expected))
    # V2REF of chip 2 cancels: the mean of that chip is laid on the table; its scale is the shift's
    floor = np.array([1e-5 if n.startswith("V") else 0.0 for n in table["PARAM"]])
    norm = np.outer(np.maximum(sd, floor), np.maximum(sd, floor))
    assert_allclose(table["COV"] / norm, expected / norm, atol=2e-3)
    # and it is there at all: roll and scale are common to both filters
    filters = table["FILTER1"]
    a = np.flatnonzero((filters == "F606W") & (table["PARAM"] == "CY10"))[0]
    b = np.flatnonzero((filters != "F606W") & (table["PARAM"] == "CY10"))[0]
    assert abs(expected[a, b] / norm[a, b]) > 1e-2


def test_the_gauge_of_the_fit_is_not_in_the_file(solutions) -> None:
    """A solution turned by 57 deg and shifted, then brought to the reference gauge: same file."""
    base = solutions["F606W"]
    reference = reference_of(base)
    names = {"epoch": 2004.5, "reference_drift": False}
    o = laid_on(base, reference, **names, scale_arcsec=1.0)
    away = turned_by(base, replace(o, angle=1.0, shift=np.array([100.0, -50.0]))).solution
    away = StandIn(replace(away.model, unit="pix"), away.mean, away.cov)
    covariances = []
    for solution in (base, reference_gauge(away, 2)):
        o = laid_on(solution, reference, **names, scale_arcsec=0.05)
        stored, _ = storable(turned_by(solution, o), years=(2009.4, 2015.0), segment=1)
        made = idctab_from_solution({"F606W": stored}, **ACS, scale_arcsec=0.05)
        covariances.append(made.covariance)
    a, b = covariances
    assert_allclose(a["VALUE"], b["VALUE"], rtol=1e-11)
    sd = np.sqrt(np.diag(a["COV"]))
    assert_allclose(a["COV"] / np.outer(sd, sd), b["COV"] / np.outer(sd, sd), atol=1e-5)


def test_filters_of_both_wheels_are_those_of_the_real_table(data_dir) -> None:
    real = read_idctab(data_dir / "hst_reference" / "0461802ej_idc.fits")
    clear1 = {f[1] for f in real.filters() if f[0] == "CLEAR1L"} - {"CLEAR2L", "CLEAR2S"}
    clear2 = {f[0] for f in real.filters() if f[1] == "CLEAR2L"} - {"CLEAR1L"}
    assert clear1 and clear2
    for name in clear1:
        assert combination_of(name, "ACS") == ("CLEAR1L", name)
    for name in clear2:
        assert combination_of(name, "ACS") == (name, "CLEAR2L")
    assert combination_of("F606W", "WFC3") == ("F606W",)
    with pytest.raises(InputError, match="wheel of 'F999W' is not known"):
        combination_of("F999W", "ACS")


def test_the_lint_knows_which_sigma_is_whose(release, tmp_path) -> None:
    """A wrong sigma of one filter alone is found, though the other filter's is right."""
    path = tmp_path / "bad_idc.fits"
    with fits.open(release.idctabs["pre"]) as hdus:
        table = hdus["SIGMA"].data
        [row] = np.flatnonzero(
            (table["FILTER2"] == "F814W") & (table["DETCHIP"] == 1)
            & (np.char.strip(table["DIRECTION"]) == "FORWARD")
        )  # fmt: skip
        table["CX11"][row] *= 1.01
        hdus.writeto(path)
    [finding] = lint_idctab(read_idctab(path))
    assert finding.level == "error" and "sigma and covariance differ" in finding.message


@dataclass(frozen=True, eq=False)
class Sampled(StandIn):
    """A stand-in for a posterior that has not converged."""

    convergence: object = field(default_factory=lambda: SimpleNamespace(converged=False))


def test_draws_and_convergence_come_through(solutions) -> None:
    """Turned and cut to a segment, a posterior is still one; its draws have its covariance."""
    base = solutions["F606W"]
    sampled = Sampled(base.model, base.mean, base.cov)
    o = laid_on(sampled, reference_of(base), epoch=2004.5, reference_drift=False)
    held, _ = storable(turned_by(sampled, o), years=(2009.5, 2015.0), segment=1)
    stored = held.solution
    assert stored.kind == "posterior"
    header = idctab_from_solution({"F606W": held}, **ACS, scale_arcsec=0.05).header
    assert header["BDCONV"] == "NO" and "NOT CONVERGED" in str(header["COMMENT"])
    plain, _ = storable(turned_by(base, o), years=(2009.5, 2015.0), segment=1)
    assert plain.solution.kind == "least squares"
    n = 3000
    draws = stored.draws(n, np.random.default_rng(7))
    ratio = draws.std(axis=0) / np.sqrt(np.diag(stored.cov))
    assert_allclose(ratio, 1.0, atol=5.5 / np.sqrt(2 * n))
    assert np.abs((draws.mean(axis=0) - stored.mean) / draws.std(axis=0)).max() < 5.5 / np.sqrt(n)


# -- refusals -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"calibrations": {}}, "no filter is given"),
        ({"periods": ()}, "no period is given"),
        ({"periods": (PERIODS[0], PERIODS[0])}, "two periods have the same name"),
        ({"stand_ins": {"F555W": "F435W"}}, "'F435W' is to replace"),
        ({"tables": (LookupTable(1, np.zeros((2, 2, 2)), "F435W"),)}, "without a solution"),
        ({"limit_mas": 0.01}, "cannot store drifts"),
        ({"periods": (replace(PERIODS[0], segment=2),)}, "no segment 2"),
    ],
)
def test_wrong_sets_are_refused_before_a_file_is_written(
    change, message, solutions, orientation, tmp_path
) -> None:
    names = {
        "calibrations": calibrations(solutions),
        "orientation": orientation,
        "periods": PERIODS,
        **change,
    }
    with pytest.raises(InputError, match=message):
        write_release(tmp_path / "new", "acs", **names)
    assert not (tmp_path / "new").exists()


def test_a_filter_that_stands_still_is_refused(solutions, orientation, tmp_path: Path) -> None:
    """Its coefficients would be taken for those of both reference dates."""
    still = solutions["F814W"]
    n = still.model.n_polynomial
    still = StandIn(replace(still.model, time=None), still.mean[:n], still.cov[:n, :n])
    with pytest.raises(InputError, match="does not depend on time"):
        write_release(
            tmp_path,
            "acs",
            calibrations({"F606W": solutions["F606W"], "F814W": still}),
            orientation,
            PERIODS,
        )


def test_solutions_that_do_not_go_into_one_table_are_refused(solutions, orientation) -> None:
    base, _ = storable(turned_by(solutions["F606W"], orientation), years=(2002.2, 2009.4))
    mean, cov = base.solution.mean, base.solution.cov
    moved = mean.copy()
    moved[base.model.tdd_slice(1).start] *= 1.01
    other = replace(base, solution=GaussianSolution(base.model, moved, cov))
    with pytest.raises(InputError, match="drift differs from that of the first filter"):
        idctab_from_solution({"F606W": base, "F814W": other}, **ACS)
    with pytest.raises(InputError, match="occurs twice"):
        idctab_from_solution({"F606W": base, ("F606W", "CLEAR2L"): base}, **ACS)
    with pytest.raises(InputError, match="filters are given twice"):
        idctab_from_solution({"F606W": base}, **ACS, filters=("F606W", "CLEAR2L"))
    with pytest.raises(InputError, match="no filter is given"):
        idctab_from_solution({}, **ACS)
    chips = (base.model.chips[1],)
    n = 2 * base.model.n_terms
    single = calibration_of(
        StandIn(replace(base.model, chips=chips, time=None), mean[:n], np.eye(n))
    )
    with pytest.raises(InputError, match="order or chips differ"):
        idctab_from_solution({"F606W": base, "F814W": single}, **ACS)
    # the very same drift is no difference
    same = idctab_from_solution(
        {"F606W": base, "F814W": replace(base, solution=replace(base.solution))}, **ACS
    )
    assert len(same.rows) == 4
