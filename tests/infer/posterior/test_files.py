"""fit.nc and posterior.nc: round trips, other programs that open them, and damaged files."""

from __future__ import annotations

import json
import resource
from dataclasses import replace

import h5py
import numpy as np
import pytest
import xarray as xr

from bayesdist.errors import FormatError, InputError
from bayesdist.infer import (
    OutlierMixture,
    Rejection,
    fit_linear,
    load_fit,
    load_posterior,
    memberships,
    sample,
    save_fit,
    save_posterior,
)
from bayesdist.model import TimeDependence
from tests.reduced import case_in_full

from ..support import TWO_CHIPS, simulated

pytestmark = pytest.mark.usefixtures("one_thread")

MIXTURES = {
    "gaussian": OutlierMixture(),
    "uniform": OutlierMixture("uniform", match_radius=2.0, fraction_prior=(1.0, 5.0)),
    "none": OutlierMixture("none", jitter=0.0),
}


@pytest.fixture(scope="module")
def campaign():
    model, matches, _ = simulated(
        81,
        300,
        frames="shift_rotation",
        n_exposures=2,
        chips=TWO_CHIPS,
        time=TimeDependence((("u", 1, 0),), (2005.0, 2010.0), (2009.0,)),
        epochs=[2003.0, 2005.0],
        fraction=0.05,
    )
    still = replace(model, time=None)
    return still, matches, fit_linear(matches, still)


@pytest.fixture(scope="module", params=MIXTURES, ids=str)
def written(request, campaign, tmp_path_factory):
    _, matches, fit = campaign
    posterior = sample(fit, matches, outliers=MIXTURES[request.param], max_steps=60, seed=8)
    path = tmp_path_factory.mktemp("files") / "posterior.nc"
    save_posterior(posterior, matches, path, provenance={"seed": 8, "inputs": ["a.ecsv"]})
    return posterior, matches, path


@pytest.fixture(scope="module")
def az():
    import arviz

    return arviz


# what is asked of a damaged file is asked of that of one mixture
OF_ONE = pytest.mark.parametrize(
    "written",
    [
        "gaussian",
        *(case_in_full(k, instead="another mixture is run") for k in MIXTURES if k != "gaussian"),
    ],
    indirect=True,
)


def test_posterior_round_trip(written):
    posterior, _, path = written
    again = load_posterior(path)
    assert again.model == posterior.model and again.mixture == posterior.mixture
    assert again.sampler == posterior.sampler
    for name in ("theta", "log_prob", "mean", "cov"):
        np.testing.assert_array_equal(getattr(again, name), getattr(posterior, name))
    for name in ("n_stars", "n_flagged", "n_false", "reference_sigma"):
        assert getattr(again, name) == getattr(posterior, name)
    assert again.hyper.keys() == posterior.hyper.keys()
    for name, values in posterior.hyper.items():
        np.testing.assert_array_equal(again.hyper[name], values)
    c, d = posterior.convergence, again.convergence
    assert (d.names, d.reasons, d.converged, d.limits) == (
        c.names,
        c.reasons,
        c.converged,
        c.limits,
    )
    assert (d.pareto_k, d.importance_efficiency) == (c.pareto_k, c.importance_efficiency)
    for name in ("rhat", "ess_bulk", "ess_tail", "mcse_mean", "mcse_sd"):
        np.testing.assert_array_equal(getattr(d, name), getattr(c, name))
    np.testing.assert_array_equal(load_posterior(path.parent).theta, posterior.theta)


def test_arviz_opens_it(written, az):
    posterior, matches, path = written
    data = az.from_netcdf(path)
    assert {"posterior", "sample_stats", "observed_data", "constant_data", "log_likelihood"} <= set(
        data.groups()
    )
    np.testing.assert_array_equal(data.posterior["theta"].values, posterior.theta)
    assert list(data.posterior["parameter"].values) == list(posterior.model.names)
    np.testing.assert_array_equal(data.observed_data["u"].values, matches.u)
    # and can work with it
    summary = az.summary(data, var_names=["theta"], kind="stats", round_to="none")
    np.testing.assert_allclose(summary["mean"], posterior.mean, rtol=1e-9, atol=1e-12)
    assert data.log_likelihood["uv"].dims == ("chain", "draw", "star")


def test_xarray_opens_it(written):
    posterior, matches, path = written
    with xr.open_datatree(path, engine="h5netcdf") as tree:
        assert set(tree.children) == {
            "posterior",
            "sample_stats",
            "diagnostics",
            "observed_data",
            "constant_data",
            "log_likelihood",
        }
        np.testing.assert_array_equal(tree["sample_stats"]["lp"], posterior.log_prob)
        constants = tree["constant_data"]
        np.testing.assert_array_equal(constants["sigma_u"], matches.sigma_u)
        np.testing.assert_array_equal(constants["chip"], matches.chip_number)
        p = memberships(posterior, matches).outlier_probability
        np.testing.assert_array_equal(constants["outlier_probability"], p)
        assert constants.attrs["unit"] == "pix"
        assert json.loads(tree.attrs["provenance"]) == {"seed": 8, "inputs": ["a.ecsv"]}
        assert tree.attrs["schema"] == 4
        assert json.loads(tree["posterior"].attrs["units"]) == list(posterior.model.units)


def test_log_likelihood_of_the_stars_adds_up(written, az):
    """The sum over stars plus the log prior is the log density that the sampler saw."""
    posterior, _, path = written
    total = az.from_netcdf(path).log_likelihood["uv"].sum("star").values
    difference = posterior.log_prob - total
    if posterior.mixture.hyper:
        hyper = posterior.mixture.bind(0.05)
        h = hyper.point(posterior.hyper)
        difference = difference - hyper.log_prior(h)
    np.testing.assert_allclose(difference, 0, atol=1e-6)


def test_what_is_said_of_each_star_is_the_mean_over_some_draws(written, az):
    """Where draws times stars are too many for the file, this is what takes their place."""
    posterior, matches, path = written
    found = memberships(posterior, matches)
    full = az.from_netcdf(path).log_likelihood["uv"].values.reshape(-1, len(matches))
    some = np.linspace(0, len(full) - 1, found.draws).astype(int)
    np.testing.assert_allclose(found.log_likelihood, full[some].mean(axis=0), rtol=1e-9)
    np.testing.assert_allclose(
        found.log_likelihood_variance, full[some].var(axis=0), rtol=1e-5, atol=1e-8
    )


@OF_ONE
def test_large_runs_leave_out_star_times_draw_and_then_the_stars(written, az, tmp_path):
    posterior, matches, _ = written
    max_bytes = posterior.log_prob.size * len(matches) * 8 - 1
    save_posterior(posterior, matches, tmp_path / "big.nc", max_bytes=max_bytes)
    draws = {"posterior", "sample_stats", "diagnostics"}
    with xr.open_datatree(tmp_path / "big.nc", engine="h5netcdf") as tree:
        assert set(tree.children) == draws | {"observed_data", "constant_data"}
    save_posterior(posterior, matches, tmp_path / "larger.nc", max_stars=len(matches) - 1)
    save_posterior(posterior, None, tmp_path / "none.nc")
    for name in ("larger.nc", "none.nc"):
        with xr.open_datatree(tmp_path / name, engine="h5netcdf") as tree:
            assert set(tree.children) == draws
        az.from_netcdf(tmp_path / name)
        np.testing.assert_array_equal(load_posterior(tmp_path / name).theta, posterior.theta)


@OF_ONE
def test_an_older_file_stays_when_writing_fails(written, tmp_path):
    """A limit on the size of files is what a full disk is: the system takes no more bytes."""
    posterior, matches, _ = written
    target = tmp_path / "posterior.nc"
    target.write_bytes(b"older")
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (4096, hard))
    try:
        with pytest.raises(InputError, match=r"posterior\.nc: cannot be written"):
            save_posterior(posterior, matches, target)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert target.read_bytes() == b"older"
    assert [p.name for p in tmp_path.iterdir()] == ["posterior.nc"]


# h5netcdf leaves half-opened files behind, whose own clean-up fails
UNCLOSED = pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")


@UNCLOSED
@OF_ONE
@pytest.mark.parametrize("damage", ["empty", "cut", "header", "text", "other netCDF", "directory"])
def test_a_damaged_posterior_is_named(written, campaign, tmp_path, damage):
    *_, path = written
    data, bad = path.read_bytes(), tmp_path / "bad.nc"
    if damage == "other netCDF":
        xr.Dataset({"a": ("x", [1.0])}).to_netcdf(bad, engine="h5netcdf")
    elif damage == "directory":
        bad.mkdir()  # a run that has not been sampled
    else:
        bad.write_bytes(
            {
                "empty": b"",
                "cut": data[: len(data) // 2],
                "header": bytes(200) + data[200:],
                "text": b"chain,draw,u_0_0\n0,0,1.5\n",
            }[damage]
        )
    with pytest.raises(FormatError, match=r"bad\.nc"):
        load_posterior(bad)


def test_a_fit_is_no_posterior_and_a_missing_file_is_missing(campaign, tmp_path):
    *_, fit = campaign
    save_fit(fit, tmp_path / "fit.nc")
    with pytest.raises(FormatError, match=r"fit\.nc"):
        load_posterior(tmp_path / "fit.nc")
    with pytest.raises(FormatError, match=r"missing\.nc: there is no such file"):
        load_posterior(tmp_path / "missing.nc")
    with pytest.raises(FormatError, match=r"missing\.nc: there is no such file"):
        load_fit(tmp_path / "missing.nc")


NUMBERS = (
    *("n_rows", "n_used", "n_rejected", "rms_u", "rms_v", "rms_rejected"),
    *("chi2", "dof", "condition"),
)


@pytest.mark.parametrize(
    "options", [{}, {"rejection": Rejection(clip_abs=None)}], ids=["clipped", "no absolute limit"]
)
def test_fit_round_trip(campaign, tmp_path, options):
    still, matches, _ = campaign
    fit = fit_linear(matches, still, **options)
    save_fit(fit, tmp_path / "fit.nc")
    again = load_fit(tmp_path / "fit.nc")
    assert again.model == fit.model
    for name in ("mean", "cov"):
        np.testing.assert_array_equal(getattr(again, name), getattr(fit, name))
        assert getattr(again, name).dtype == getattr(fit, name).dtype
    for name in NUMBERS:
        assert getattr(again, name) == getattr(fit, name), name
        assert type(getattr(again, name)) is type(getattr(fit, name)), name
    assert again.rejected == fit.rejected
    # the rule that tells which stars were used comes back whole, infinite limits included
    np.testing.assert_array_equal(again.clip.theta, fit.clip.theta)
    for name in ("chi2_limit", "abs_limit", "spared_chi2"):
        assert getattr(again.clip, name) == getattr(fit.clip, name), name
    np.testing.assert_array_equal(again.uses(matches), fit.uses(matches))
    assert again.uses(matches).sum() == fit.n_used < len(matches)
    with xr.open_dataset(tmp_path / "fit.nc", engine="h5netcdf") as data:
        one = data["cov"].sel(parameter="A.u_1_0", parameter_2="A.u_1_0").item()
        k = fit.model.names.index("A.u_1_0")
        assert one == fit.cov[k, k]


@OF_ONE
@pytest.mark.parametrize("damage", ["empty", "cut", "text", "posterior"])
def test_a_damaged_fit_is_named(written, campaign, tmp_path, damage):
    *_, fit = campaign
    *_, posterior_path = written
    path = tmp_path / "fit.nc"
    save_fit(fit, path)
    data = path.read_bytes()
    path.write_bytes(
        {
            "empty": b"",
            "cut": data[: len(data) // 2],
            "text": b"u_0_0 1.5\n",
            "posterior": posterior_path.read_bytes(),
        }[damage]
    )
    with pytest.raises(FormatError, match=r"fit\.nc"):
        load_fit(path)


def test_a_fit_without_a_number_that_is_needed_has_to_be_made_again(campaign, tmp_path):
    """As a file that was written before the limit of spared pairs was stored."""
    *_, fit = campaign
    path = tmp_path / "fit.nc"
    save_fit(fit, path)
    with h5py.File(path, "a") as file:
        del file.attrs["clip_spared_chi2"]
    with pytest.raises(
        FormatError, match=r"fit\.nc: .*make it again with 'bayesdist stage fit RUN'"
    ):
        load_fit(path)


@pytest.mark.parametrize("kind", ["fit", "posterior"])
def test_damage_that_hdf5_reports_in_its_own_way(tmp_path, monkeypatch, kind):
    """h5py raises RuntimeError where the dimension scales are damaged."""

    def broken(*args, **kwargs):
        raise RuntimeError("Unspecified error in H5DSget_num_scales (return value <0)")

    name, load = {
        "fit": ("open_dataset", load_fit),
        "posterior": ("open_datatree", load_posterior),
    }[kind]
    monkeypatch.setattr(xr, name, broken)
    path = tmp_path / "bad.nc"
    path.write_bytes(b"whatever")
    with pytest.raises(FormatError, match=r"bad\.nc"):
        load(path)


HARM = {
    "nan": lambda values: np.full(values.shape, np.nan),
    "short": lambda values: values[:-1],
    "flat": lambda values: values.reshape(-1),
    "text": lambda values: "text",
    "number": lambda values: 1.0,
}


@OF_ONE
@pytest.mark.parametrize("how", [*HARM, "gone"])
@pytest.mark.parametrize("name", ["posterior/theta", "sample_stats/lp", "diagnostics/rhat"])
def test_arrays_of_a_posterior_that_are_not_as_they_were(written, tmp_path, name, how):
    """Whatever stands in their place, the answer is a posterior or one error."""
    path = tmp_path / "posterior.nc"
    path.write_bytes(written[2].read_bytes())
    with h5py.File(path, "r+") as file:
        values = file[name][...]
        del file[name]
        if how != "gone":
            file[name] = HARM[how](values)
    if name == "diagnostics/rhat" and how == "flat":
        return  # it has one dimension anyway
    with pytest.raises(FormatError, match=r"posterior\.nc: this is not a posterior|damaged"):
        load_posterior(path)


@OF_ONE
@pytest.mark.parametrize("value", ["x", "[]", "null", '{"a": 1}', "[" * 5000, "9" * 5000, 1.5])
@pytest.mark.parametrize("name", ["model", "mixture", "n_stars", "creator"])
def test_attributes_of_a_posterior_that_are_not_as_they_were(written, tmp_path, name, value):
    path = tmp_path / "posterior.nc"
    path.write_bytes(written[2].read_bytes())
    with h5py.File(path, "r+") as file:
        file.attrs[name] = value
    with pytest.raises(FormatError, match=r"posterior\.nc"):
        load_posterior(path)


UNCHECKED = {"provenance", "wall_s"}


def _changed(file: h5py.File):
    """Change one attribute or number of an HDF5 file at a time, and name it."""
    members = ["/"]
    file.visit(members.append)
    for member in members:
        is_array = isinstance(file[member], h5py.Dataset)
        for name, value in dict({} if is_array else file[member].attrs).items():
            if name in UNCHECKED or name.startswith("_"):
                continue
            changed = value.replace("e", "a", 1) if isinstance(value, str) else value + 1
            changed = 1 - value if name in ("converged", "own_places") else changed
            if np.any(changed != value):  # infinity and texts without an e stay as they are
                file[member].attrs[name] = changed
                yield f"{member} {name}"
                file[member].attrs[name] = value
        if is_array and not file[member].is_scale:
            values = file[member][...]
            changed = values.copy()
            changed.flat[-1] = np.nextafter(values.flat[-1], np.inf)
            file[member][...] = changed
            yield member
            file[member][...] = values


@OF_ONE
@pytest.mark.parametrize("kind", ["posterior", "fit"])
def test_a_change_of_one_number_or_text_is_noticed(written, campaign, tmp_path, kind):
    path, load = tmp_path / f"{kind}.nc", {"posterior": load_posterior, "fit": load_fit}[kind]
    save_fit(campaign[2], path)
    if kind == "posterior":
        save_posterior(written[0], None, path)
    load(path)
    names = []
    with h5py.File(path, "r+") as file:
        for name in _changed(file):
            file.flush()
            names.append(name)
            with pytest.raises(FormatError, match=rf"{kind}\.nc"):
                load(path)
    assert len(names) >= {"posterior": 28, "fit": 14}[kind], names


@OF_ONE
def test_what_others_add_to_a_posterior_is_ignored(written, tmp_path):
    path = tmp_path / "posterior.nc"
    path.write_bytes(written[2].read_bytes())
    with h5py.File(path, "r+") as file:
        file.attrs["history"] = "2026-11-30: scale added"
        file["posterior"].attrs["history"] = "the same"
        file["posterior/scale"] = file["posterior/theta"][..., 1] ** 2
        file["summary/mean"] = [1.0, 2.0]
    np.testing.assert_array_equal(load_posterior(path).theta, written[0].theta)


@OF_ONE
@pytest.mark.parametrize("kind", ["posterior", "fit"])
def test_a_file_without_a_checksum_is_said_to_be_of_an_earlier_revision(
    written, campaign, tmp_path, kind
):
    path, load = tmp_path / f"{kind}.nc", {"posterior": load_posterior, "fit": load_fit}[kind]
    save_fit(campaign[2], path)
    if kind == "posterior":
        save_posterior(written[0], None, path)
    with h5py.File(path, "r+") as file:
        del file.attrs["checksum"]
    with pytest.raises(FormatError, match=rf"{kind}\.nc.*no checksum: an earlier revision"):
        load(path)
