"""What the four published WISE bands say against themselves.

Source: WSDC D-T033, "WISE IOC Distortion Calibration", Appendix B (current SIP coefficients for
ops), digit by digit as printed.
"""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from bayesdist.calibration.inverse import fit_inverse
from bayesdist.errors import FormatError, InputError
from bayesdist.formats.sip.files import write_sip
from bayesdist.formats.sip.header import worst_closure
from bayesdist.formats.sip.lint import lint_sip
from bayesdist.missions.wise.meta_data.format import lint_wise_band
from bayesdist.missions.wise.meta_data.implied import implied_values, wrong_coefficient
from bayesdist.missions.wise.meta_data.meta import read_wise_meta
from bayesdist.products import describe, lint
from bayesdist.products.common.coefficients import evaluate, largest_magnitude
from tests.reduced import case_in_full, only_in_full

# band: (A_DMAX, B_DMAX), then rows of p_q, A, B, AP, BP
# fmt: off
PRINTED: dict[int, tuple[tuple[str, str], str]] = {
    1: (("2.046", "1.066"), """
        0_0   7.228039E-01  -7.946909E-02  -7.233219E-01   7.930997E-02
        1_0  -7.790246E-04  -2.481941E-04   7.777227E-04   2.484437E-04
        0_1  -1.243220E-04   3.218232E-04   1.261763E-04  -3.239962E-04
        2_0  -1.629945E-06  -6.590985E-08   1.636841E-06   6.524476E-08
        1_1   1.344445E-06  -3.541684E-06  -1.342059E-06   3.542573E-06
        0_2  -7.793528E-06  -3.541684E-06   7.795772E-06  -1.163635E-06
        3_0   2.756392E-09  -6.360093E-11  -2.759976E-09   6.293886E-11
        2_1  -1.186318E-10  -2.600160E-10   1.107923E-10   2.734704E-10
        1_2   1.228555E-09  -4.987962E-10  -1.159637E-09   4.895069E-10
        0_3  -2.928111E-10  -3.174803E-09   2.696271E-10   3.198763E-09
        4_0   1.794526E-12   8.797685E-13  -1.804259E-12  -8.708176E-13
        3_1  -4.586393E-13   7.028808E-13   4.712913E-13  -7.164364E-13
        2_2   1.503974E-12  -2.594371E-13  -1.580363E-12   2.664114E-13
        1_3  -5.895443E-13   1.458031E-12   6.084245E-13  -1.423222E-12
        0_4  -6.270019E-13  -8.545365E-13   6.665114E-13   8.509823E-13
    """),
    2: (("2.083", "1.089"), """
        0_0   7.597772E-01  -9.433609E-02  -7.601833E-01   9.412452E-02
        1_0  -5.040463E-04  -2.026974E-04   5.022762E-04   2.031710E-04
        0_1  -1.192789E-04   5.505028E-04   1.214455E-04  -5.536797E-04
        2_0  -1.349460E-06   8.038015E-08   1.357302E-06  -7.895137E-08
        1_1   1.082862E-06  -3.953933E-06  -1.080554E-06   3.953409E-06
        0_2  -8.064834E-06   1.091415E-06   8.060749E-06  -1.087708E-06
        3_0   2.959435E-09   1.067827E-10  -2.964908E-09  -1.087914E-10
        2_1  -1.297961E-09   4.101600E-10   1.285175E-09  -3.948197E-10
        1_2   3.389170E-10  -9.316313E-10  -2.655445E-10   9.209293E-10
        0_3  -4.935791E-10  -3.840921E-09   4.733730E-10   3.865684E-09
        4_0   1.787756E-12  -1.788157E-13  -1.795530E-12   1.753401E-13
        3_1  -6.743610E-13   1.952342E-12   6.893457E-13  -1.963102E-12
        2_2   2.075723E-12  -5.705721E-13  -2.174012E-12   5.843392E-13
        1_3  -5.769507E-13   8.534495E-13   6.091029E-13  -8.239603E-13
        0_4  -1.303108E-13  -5.181754E-13   1.892303E-13   5.128681E-13
    """),
    3: (("2.095", "1.300"), """
        0_0   7.358456E-01  -8.389715E-02  -7.361246E-01   8.332980E-02
        1_0 -4.8377784E-04  -6.788420E-04   4.828724E-04   6.793719E-04
        0_1  -6.410136E-04   5.030167E-04   6.419018E-04  -5.046199E-04
        2_0  -1.754315E-06   5.414236E-07   1.760895E-06  -5.369960E-07
        1_1   8.952514E-07  -3.515651E-06  -8.797586E-07   3.513457E-06
        0_2  -8.308111E-06   5.610990E-07   8.303367E-06  -5.522436E-07
        3_0   2.879012E-09   8.619879E-11  -2.889421E-09  -8.895805E-11
        2_1  -9.762929E-10   1.285471E-10   9.707856E-10  -1.178523E-10
        1_2   3.550849E-10  -2.476911E-10  -2.883046E-10   2.489261E-10
        0_3  -1.625272E-10  -3.660396E-09   1.574646E-10   3.670489E-09
        4_0   3.033166E-12  -7.304812E-13  -3.042306E-12   7.251477E-13
        3_1  -3.960689E-12   1.482141E-12   3.947562E-12  -1.490019E-12
        2_2   1.454345E-12  -2.083238E-12  -1.524870E-12   2.077496E-12
        1_3  -9.680264E-13   9.798616E-13   9.855525E-13  -9.405921E-13
        0_4   2.677086E-13   1.671433E-14  -2.102217E-13  -2.075438E-14
    """),
    4: (("0.971", "0.582"), """
        0_0   4.454888E-01  -5.775286E-02  -4.457576E-01   5.767048E-02
        1_0  -6.246135E-04  -1.431559E-04   6.204521E-04   1.440997E-04
        0_1   1.798126E-04   5.474906E-04  -1.781952E-04  -5.516974E-04
        2_0  -4.103560E-06   1.315098E-06   4.123874E-06  -1.314523E-06
        1_1   1.123638E-06  -7.968204E-06  -1.123275E-06   7.959111E-06
        0_2  -1.719398E-05   1.364385E-06   1.719030E-05  -1.363994E-06
        3_0   1.242150E-08  -5.358762E-10  -1.266208E-08   5.235808E-10
        2_1  -2.036670E-09   9.606579E-10   2.033637E-09  -8.924626E-10
        1_2   3.241247E-09  -9.571209E-10  -2.907111E-09   9.315308E-10
        0_3   3.413039E-10  -1.534179E-08  -3.781631E-10   1.517287E-08
        4_0   1.445548E-11  -1.173857E-11  -1.463342E-11   1.174041E-11
        3_1  -3.249992E-11   1.290359E-11   3.258225E-11  -1.295506E-11
        2_2   1.857739E-11  -1.052149E-11  -1.931343E-11   1.061448E-11
        1_3  -3.767396E-12   5.169349E-12   3.797752E-12  -4.678544E-12
        0_4   3.375647E-12  -1.931603E-12  -2.994271E-12   1.958353E-12
    """),}
# fmt: on
FAMILIES = ("A", "B", "AP", "BP")
VARIABLES = {"A": "uv", "B": "uv", "AP": "UV", "BP": "UV"}


def comment(family: str, p: int, q: int) -> str:
    """As in the appendix, with its slip: u3.v is printed as u2.v."""
    axis = 1 if family in ("A", "AP") else 2
    u, v = VARIABLES[family]
    if (p, q) == (3, 1):
        p = 2
    power = ["", "", "2", "3", "4"]
    if p and q:
        return f"axis {axis} distortion coefficient of {u}{power[p]}.{v}{power[q]}"
    return f"axis {axis} distortion coefficient of {u if p else v}{p + q}"


def meta_data(bands=(1, 2, 3, 4)) -> str:
    """The file that the appendix prints."""
    lines = []

    def entry(band: int, keyword: str, kind: str, value: str, text: str) -> None:
        name = f"cal:gnd:distort_{keyword.lower()}"
        lines.append(f"{name:<24} {band}    {keyword:<8} {kind} {value:>18} {text}")

    for band in bands:
        maxima, table = PRINTED[band]
        rows = [line.split() for line in table.split("\n") if line.strip()]
        lines += ["\\", f"\\ w{band}", "\\"]
        entry(band, "SKEW", "r", "0.000000E+00", "[rad] skew component of CD matrix")
        for k, family in enumerate(FAMILIES):
            entry(band, f"{family}_ORDER", "i", "4", "polynomial order")
            for powers, *values in rows:
                p, q = map(int, powers.split("_"))
                entry(band, f"{family}_{powers}", "r", values[k], comment(family, p, q))
            if k < 2:
                entry(band, f"{family}_DMAX", "r", maxima[k], "[pixel] maximum correction")
    return "\n".join(lines) + "\n"


@pytest.fixture(scope="module")
def bands(tmp_path_factory):
    path = tmp_path_factory.mktemp("meta") / "wise.meta"
    path.write_text(meta_data())
    return {one.band: one for one in read_wise_meta(path)}


def said(findings, level: str = "") -> list[str]:
    return [str(f) for f in findings if f.level.startswith(level)]


def with_b_0_2(sip, value: float):
    return replace(sip, b={**sip.b, (0, 2): value})


# -- reading --------------------------------------------------------------------------------------


def test_numbers_are_those_of_the_appendix(bands) -> None:
    """Counted and summed by eye from the print: 4 x 60 coefficients, order 4, no skew."""
    for band, one in bands.items():
        sip = one.sip
        assert [len(t) for t in (sip.a, sip.b, sip.ap, sip.bp)] == [15] * 4
        assert sip.order == sip.inverse_order == (4, 4) and one.skew == 0
        assert sip.size == ((508, 508) if band == 4 else (1016, 1016))
        assert sip.crpix == ((254.5, 254.5) if band == 4 else (508.5, 508.5))
    assert bands[1].sip.b[0, 2] == bands[1].sip.b[1, 1] == -3.541684e-06
    assert bands[4].sip.ap[4, 0] == -1.463342e-11
    assert bands[3].sip.dmax == (2.095, 1.300)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (" A_2_0 ", " A_0_2 ", "line 9: the name says A_2_0 and the keyword A_0_2"),
        ("-1.629945E-06", "-1.629945F-06", "band 1, keyword A_2_0: value '-1.629945F-06' is no"),
        (" r -1.629945E-06", " -1.629945E-06", "line 9: is not name, band, keyword, type, value"),
        ("_a_2_0 1 ", "_a_2_0 7 ", "line 9: band 7 is none of 1 to 4"),
        ("_a_1_1 1 A_1_1", "_a_2_0 1 A_2_0", "line 10: A_2_0 of band 1 occurs a second time"),
        ("_a_order 1 A_ORDER", "_a_other 1 A_OTHER", "line 5: A_OTHER is not a SIP keyword"),
        (" 1 B_ORDER", " 2 B_ORDER", "B_ORDER: is missing"),
        (" A_ORDER i 4", " A_ORDER i four", "value 'four' is not a finite number"),
    ],
)
def test_broken_lines_are_named(tmp_path, old: str, new: str, message: str) -> None:
    text = re.sub(" +", " ", meta_data((1,)))
    assert text.count(old) == 1
    (tmp_path / "w.meta").write_text(text.replace(old, new))
    with pytest.raises(FormatError, match=message):
        read_wise_meta(tmp_path / "w.meta")


def test_a_file_without_entries_is_refused(tmp_path) -> None:
    (tmp_path / "w.meta").write_text("cal:gnd:scale 1 WPSCALE r 2.75 scale\n")
    with pytest.raises(FormatError, match="no distortion entries"):
        read_wise_meta(tmp_path / "w.meta")
    with pytest.raises(InputError, match=r"give .*, WISE meta-data, "):
        describe(tmp_path / "w.meta")


# -- what contradicts what ------------------------------------------------------------------------


def test_only_w1_has_a_wrong_coefficient(bands) -> None:
    for band in (2, 3, 4):
        assert said(lint_wise_band(bands[band]), "error") == []
    errors = said(lint_wise_band(bands[1]), "error")
    assert len(errors) == 2
    assert errors[0].startswith("error: B_0_2: is -3.541684e-06, and AP, BP and B_DMAX imply +1.16")
    assert "what stands there is the value of B_1_1" in errors[0]


def test_the_copied_coefficient_of_w1_is_found_three_ways(bands) -> None:
    sip = bands[1].sip
    text = "\n".join(said(lint_sip(sip, explain=wrong_coefficient)))
    assert "warning: B_1_1, B_0_2: the same value, 3.541684e-06" in text
    assert "warning: B_DMAX: says 1.066 px" in text
    assert "error: AP, BP: they miss the inverse" in text
    # the published inverse says what it must be, but for terms of second order in the distortion
    right = lint_sip(with_b_0_2(sip, -sip.bp[0, 2]), explain=wrong_coefficient)
    assert said(right, "error") == said(right, "warning") == []
    low = "A_0_0, A_1_0, A_0_1, B_0_0, B_1_0, B_0_1: constant or linear terms"
    assert any(low in text for text in said(right, "note"))


def test_the_checks_of_sip_headers_name_the_wrong_coefficient(bands, tmp_path) -> None:
    """The format finds the check by the plugin; without it, only the closure is reported."""
    write_sip(bands[1].sip, tmp_path / "w1.hdr")
    [wrong, closure] = said(lint(tmp_path / "w1.hdr"), "error")
    assert wrong.startswith("error: B_0_2: is -3.541684e-06, and AP, BP and B_DMAX imply +1.16")
    assert said(lint_sip(bands[1].sip), "error") == [closure]
    assert closure.startswith("error: AP, BP: they miss the inverse")


def test_b_0_2_of_w1_is_positive_and_satisfies_all_that_was_printed(bands) -> None:
    sip = bands[1].sip
    first, second, *_ = implied_values(sip)
    assert first.keyword == "B_0_2" and first.probability > 1 - 1e-9
    # neither the inverse nor the coefficient whose value stands there can explain it
    assert second.probability < 1e-9
    whole = with_b_0_2(sip, first.value)
    assert worst_closure(whole, sip.size) < 0.0021
    # B_DMAX has three decimals, and was no more than a bound here
    reach = [(-507.5, 507.5)] * 2
    assert abs(largest_magnitude(whole.b, *reach) - 1.066) < 0.0005
    # fitting an inverse is another route than solving for the coefficient
    g = np.linspace(-508, 508, 33)
    U, V = (w.ravel() for w in np.meshgrid(g, g))

    def misfit(value: float) -> float:
        tried = with_b_0_2(sip, value)
        _, bp = fit_inverse(tried.forward, tried.crpix, tried.size, 4)
        return float(np.sqrt(np.mean((evaluate(bp, U, V) - evaluate(sip.bp, U, V)) ** 2)))

    at = misfit(first.value)
    assert at < min(misfit(first.value + k * first.sigma) for k in (-4, 4))
    # the longest vector, zeroth order suppressed: 2.931 px, between pixel centres and edges
    longest = []
    for half in (507.5, 508.0):
        u, v = (g.ravel() for g in np.meshgrid([-half, half], [-half, half]))
        a, b = ({k: c for k, c in t.items() if sum(k)} for t in (whole.a, whole.b))
        longest.append(np.hypot(evaluate(a, u, v), evaluate(b, u, v)).max())
    assert longest[0] < 2.931 < longest[1]


def test_the_value_is_found_without_the_maximum_and_the_maximum_agrees(bands) -> None:
    """Two sources that know nothing of each other."""
    sip = bands[1].sip
    [alone] = [one for one in implied_values(replace(sip, dmax=(None, None)))
               if one.keyword == "B_0_2"]  # fmt: skip
    assert alone.sources == ("AP, BP",)

    def largest(value: float) -> float:
        return largest_magnitude(with_b_0_2(sip, value).b, *[(-507.5, 507.5)] * 2)

    # 1.0655 to 1.0665 px are printed as 1.066
    low, high = alone.interval
    assert 1.0655 <= largest(high) < largest(low) <= 1.0665
    # closure needs B_0_2 to a thousandth of itself
    assert alone.sigma < 1e-3 * alone.value


def test_a_digit_too_many_in_w3(bands) -> None:
    """A_1_0 is printed -4.8377784E-04; five of its decimals could be the one to drop."""
    [text] = said(lint_wise_band(bands[3]), "warning")
    assert text.startswith("warning: A_1_0: is printed with 8 digits (-4.8377784E-04)")
    for digits in ("-4.837784E-04", "-4.837774E-04", "-4.837778E-04"):
        assert digits in text
    # these would move A_DMAX from 2.095: 2.093 and 1.86 px
    assert "-4.877784E-04" not in text and "-4.377784E-04" not in text


def test_maxima_of_w4_are_those_to_the_edges(bands) -> None:
    """And those of W1 to W3 those over the pixel centres."""
    notes = said(lint_wise_band(bands[4]), "note")
    assert sum("to the edges of the outermost pixels" in text for text in notes) == 2
    for band in (2, 3):
        assert not any("DMAX" in text for text in said(lint_wise_band(bands[band])))


def test_comments_that_name_another_monomial(bands) -> None:
    for one in bands.values():
        [text] = [t for t in said(lint_wise_band(one)) if "comment" in t]
        assert text == (
            "note: A_3_1, B_3_1, AP_3_1, BP_3_1: the comment says u2.v, the indices say u3.v"
        )


def test_inspect_says_it_in_the_order_of_its_weight(tmp_path) -> None:
    (tmp_path / "wise.meta").write_text(meta_data())
    text = describe(tmp_path / "wise.meta")
    assert "WISE meta-data, W1, W2, W3, W4" in text
    assert text.index("error: B_0_2") < text.index("warning: B_DMAX") < text.index("\nW2:")
    assert "B_DMAX    1.300 px" in text  # as printed


# -- is what is implied honest? -------------------------------------------------------------------


def sound(bands):
    for band, one in bands.items():
        sip = one.sip
        yield with_b_0_2(sip, implied_values(sip)[0].value) if band == 1 else sip


def test_sound_coefficients_lie_where_the_others_imply(bands) -> None:
    """Of even degree: 95 % of them and more within their 99 % intervals.

    The intervals are a little narrow, since not all errors of the printed inverses are chance.
    Those of odd degree are left out: all bands share a bias there, as that of an inverse fitted to
    pairs with errors would be.
    """
    pulls = np.array(
        [one.pull for sip in sound(bands) for one in implied_values(replace(sip, dmax=(None, None)))
         if sum(map(int, one.keyword.split("_")[1:])) % 2 == 0]
    )  # fmt: skip
    assert pulls.size == 144
    assert (np.abs(pulls) < stats.t(17).isf(0.005) * np.sqrt(15 / 17)).mean() > 0.95


def noisy(sip, rng, sigma: float):
    """The inverse as a fit to pairs would leave it: white noise in orthonormal components."""
    half, terms = sip.size[0] / 2, sorted(sip.ap)
    u = rng.uniform(-half, half, (2, 4000))
    design = np.stack([u[0] ** i * u[1] ** j for i, j in terms], axis=1)
    scale = np.abs(design).max(axis=0)
    out = []
    for family in (sip.ap, sip.bp):
        off = rng.normal(size=4000) * sigma * np.sqrt(4000)
        moved = np.linalg.lstsq(design / scale, off, rcond=None)[0] / scale
        out.append({k: family[k] + float(d) for k, d in zip(terms, moved, strict=True)})
    return replace(sip, ap=out[0], bp=out[1])


def exact(sip):
    ap, bp = fit_inverse(sip.forward, sip.crpix, sip.size, 4)
    return replace(sip, ap=ap, bp=bp, dmax=(None, None))


@pytest.mark.slow
@only_in_full("sound coefficients are inside")
def test_intervals_hold_the_truth_as_often_as_they_say(bands) -> None:
    """Over inverses with white errors: posterior tail probabilities are uniform."""
    sip, rng = exact(bands[2].sip), np.random.default_rng(3)
    below = []
    for _ in range(30):
        found = implied_values(noisy(sip, rng, 5e-5))
        [one] = [f for f in found if f.keyword == "B_0_2"]
        below.append(stats.t(17).cdf(one.pull * np.sqrt(17 / 15)))
    assert stats.kstest(below, "uniform").pvalue > 1e-3


KEYWORDS = ("A_1_1", "B_0_3", "AP_2_0", "BP_4_0", "A_0_0")


# reduced, each keyword in one band
@pytest.mark.parametrize(
    ("band", "keyword"),
    [
        (band, keyword)
        if k % 3 == band - 2
        else case_in_full(band, keyword, instead="it is run in another band")
        for k, keyword in enumerate(KEYWORDS)
        for band in (2, 3, 4)
    ],
)
def test_a_changed_sign_is_found(bands, band: int, keyword: str) -> None:
    """In sound bands, one at a time; its former value is implied."""
    sip = bands[band].sip
    family, p, q = keyword.split("_")
    terms = getattr(sip, family.lower())
    key = (int(p), int(q))
    wrong = replace(sip, **{family.lower(): {**terms, key: -terms[key]}})
    assert worst_closure(wrong, sip.size) > 0.02
    found = implied_values(wrong)
    first = found[0]
    partner = {"A": "AP", "B": "BP", "AP": "A", "BP": "B"}[family]
    assert first.keyword in (keyword, f"{partner}_{p}_{q}")
    [one] = [f for f in found if f.keyword == keyword]
    # those of odd degree are biased in the printed inverses, by up to 2 % in W4
    assert abs(one.value - terms[key]) < 0.05 * abs(terms[key])
    assert any("sign is wrong" in text or f"or {keyword} should" in text
               for text in said(lint_sip(wrong, explain=wrong_coefficient), "error"))  # fmt: skip


def test_an_inverse_of_too_low_an_order_accuses_nobody(bands) -> None:
    sip = bands[3].sip
    ap, bp = fit_inverse(sip.forward, sip.crpix, sip.size, 2)
    low = replace(sip, inverse_order=(2, 2), ap=ap, bp=bp)
    assert worst_closure(low, sip.size) > 0.01
    assert said(lint_sip(low, explain=wrong_coefficient), "error") == []
    assert any(
        "raise AP_ORDER" in text
        for text in said(lint_sip(low, explain=wrong_coefficient), "warning")
    )


def test_nothing_is_implied_without_an_inverse(bands) -> None:
    sip = bands[2].sip
    for change in ({"size": None}, {"inverse_order": None}, {"order": (1, 4)}):
        with pytest.raises(InputError, match="requires an image size and orders"):
            implied_values(replace(sip, **change))


def test_a_header_that_says_nothing_implies_nothing_wrong(bands) -> None:
    """All coefficients zero and closed to the last bit: no division by nothing."""
    zero = dict.fromkeys(bands[2].sip.a, 0.0)
    sip = replace(bands[2].sip, a=zero, b=zero, ap=zero, bp=zero, dmax=(0.0, 0.0))
    assert all(abs(one.value) <= 4 * one.sigma for one in implied_values(sip))
    assert said(lint_sip(sip, explain=wrong_coefficient), "error") == []


def test_a_missing_coefficient_and_a_skew_are_reported(tmp_path) -> None:
    lines = meta_data((2,)).splitlines()
    kept = [line for line in lines if " B_1_3 " not in line]
    text = "\n".join(kept).replace("0.000000E+00 [rad]", "1.000000E-05 [rad]")
    (tmp_path / "w.meta").write_text(text + "\n")
    [band] = read_wise_meta(tmp_path / "w.meta")
    warnings = said(lint_wise_band(band), "warning")
    assert "warning: B_1_3: not there, so taken as zero" in warnings
    assert any(w.startswith("warning: SKEW: is 1e-05 rad") for w in warnings)
