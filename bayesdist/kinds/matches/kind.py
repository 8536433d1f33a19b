"""Runs that begin with matched stars: reading, fit with an optional prior, and sampling.

The prior may be an earlier calibration.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import cast

from bayesdist.app.config import Config
from bayesdist.app.config.run import POSTERIOR, calibration_file
from bayesdist.app.kind import RunKind
from bayesdist.app.parts import (
    FIT,
    FitArtefacts,
    converged_posterior,
    hierarchy_of,
    load_errors,
    read_stored_fit,
)
from bayesdist.app.plausibility import (
    doubt_on_positions,
    doubts_on_run,
    left_out,
    refuse_empty_segments,
    refuse_stars,
)
from bayesdist.app.result_files import load_diagnostics
from bayesdist.app.run import Run
from bayesdist.app.stars import (
    QUOTED,
    ErrorLaw,
    RunInput,
    in_circle,
    model_of,
    set_aside,
    shards_of,
)
from bayesdist.app.store.rundir import RunDirectory
from bayesdist.assess.model import with_diagnosed_errors
from bayesdist.calibration.calibration import Calibration, calibration_of
from bayesdist.calibration.prior import CalibrationPrior, prior_of_calibration
from bayesdist.data import Matches
from bayesdist.diagnose.checks import frames_doubt, frames_that_help
from bayesdist.diagnose.residuals.misfit import epoch_shift, error_scale, majority_sentence
from bayesdist.diagnose.residuals.stars import SAMPLE
from bayesdist.errors import ConfigError, DegenerateError, InputError, NotSettledError
from bayesdist.infer import (
    GaussianPriors,
    LinearFit,
    fit_by_magnitude,
    fit_linear,
    load_fit,
)
from bayesdist.infer.catalogue.added_errors import GroupedErrors, grouped_errors
from bayesdist.infer.solution.geometry import geometries, refuse_geometry
from bayesdist.infer.solution.linear import Rejection
from bayesdist.kinds.matches.config import Data, MatchesConfig
from bayesdist.kinds.matches.sources import (
    read_configured,
    read_on_plane,
    refuse_other_plane,
    source_of,
)
from bayesdist.model import DistortionModel
from bayesdist.products.registry import read_calibration
from bayesdist.utils.checks import LARGER, Check

log = logging.getLogger("bayesdist")


class MatchesKind(RunKind[MatchesConfig, Matches]):
    """Matched stars, which were matched by another program."""

    measures_centroids = False
    reads_matches = True

    def read(self, config: MatchesConfig, base: Path) -> Matches:
        """Matched stars of the files that a configuration names."""
        return read_stars(config, base)

    def match(self, run: Run) -> Run:
        """Run with fitted and held-out stars."""
        return match_stars(run)

    def fit(self, run: Run) -> Run:
        """Run with a least-squares solution, whose errors are adjusted to the residuals."""
        return fit_stars(run)

    def fit_notes(self, run: Run) -> Iterator[tuple[int, str]]:
        """Notes and warnings about the stars."""
        matches, fit = run.placed, run.fit
        logged = _warnings_of_files(matches)  # when they were read
        for note in matches.notes:
            if note not in logged:
                yield logging.INFO, note
        for text in left_out(matches):
            yield logging.INFO, f"left out in reading: {text}"
        for text in doubts_on_run(run):
            yield logging.WARNING, text
        shift = epoch_shift(run.sample, fit)
        if shift is not None and shift.significant:
            yield logging.WARNING, shift.sentence
        majority, scale = majority_sentence(fit), run.error_scale_sentence
        if scale:
            yield logging.WARNING, scale
        if text := frames_doubt(fit, run.sample, suspicious=bool(majority or scale)):
            yield logging.WARNING, text
        if run.added_errors is not None:
            yield logging.INFO, run.added_errors.sentence(fit.unit)
        if majority:
            yield logging.WARNING, majority

    def checks(self, run: Run) -> tuple[Check, ...]:
        """Checks of positions that were probably computed from the pixels, and of cut files."""
        text = doubt_on_positions(run)
        found = [("Origin of the positions", text, LARGER)] if text else []
        # missing extensions do not change the errors of the rows that were read
        found += [("Files of the matches", note, "") for note in _warnings_of_files(run.placed)]
        return tuple(Check("Matching", name, "", "", "warn", *words) for name, *words in found)

    def source(self, directory: RunDirectory) -> RunInput | None:
        """Matches in the format of a mission; None for tables."""
        config = cast(MatchesConfig, directory.config)
        source = source_of(config.data.format)
        return None if source is None else source.input_of(directory)

    def read_new_matches(
        self, config: MatchesConfig, files: Path | list[Path], release: Run, *, dated: bool
    ) -> Matches:
        """New matches, read as the section [data] states."""
        data = config.data if dated else config.data.model_copy(update={"epoch": None})
        chips = release.config.chip or config.chip

        def read(data: Data) -> Matches:
            return read_configured(files, data, size=config.detector.size, chips=chips)

        if release.kind.new_frames is None:
            matches = _on_plane_of_release(release, data, read)
        else:
            matches = read(data)
        if data.sigma != "by_magnitude":
            return matches
        errors = load_errors(release.directory.path).by_magnitude
        if errors is None:
            raise InputError(
                "errors by magnitude are requested, but the run has measured none",
                where=", ".join(matches.sources),
                do="give data.sigma another value",
            )
        return matches.with_errors(errors)

    def errors_before_fit(self, run: Run) -> ErrorLaw | None:
        """Errors of stars of a single map at all dates; None if exposures or chips differ."""
        config = cast(MatchesConfig, run.config)
        one_frame = config.model.frames == "none" and config.time() is None
        if len(config.chips()) > 1 or not one_frame:
            return None
        return self.fit(run).errors if config.data.sigma == "by_magnitude" else QUOTED


def _on_plane_of_release(release: Run, data: Data, read: Callable[[Data], Matches]) -> Matches:
    """New matches on the tangent plane of a run.

    Raises InputError if only the new matches have a tangent point, which the configuration does not
    state, or if there is another difference that `refuse_other_plane` refuses.
    """
    earlier = calibration_of(release.solution, str(release.directory.path))
    frames = release.solution.model.frames
    matches = read_on_plane(earlier, data, read, frames=frames)
    unknown = release.solution.tangent_point is None and frames in ("none", "shift")
    chosen = matches.tangent_point is not None and data.tangent_point is None
    if unknown and chosen and matches.unit == earlier.unit:
        raise InputError(
            f"the positions are RA and Dec, but u and v of {earlier.name} state no tangent point",
            where=", ".join(matches.sources),
            do="give a configuration whose data.tangent_point is that of u and v of the run",
        )
    return matches


def fit_stars(run: Run) -> Run:
    """Fit matched stars by least squares, with errors adjusted to the residuals.

    After the fit the reader of the run holds the stars for later passes.  If the fit is degenerate
    or does not settle, the error names the frames of the exposures that would help, if any.
    """
    config, stars = cast(MatchesConfig, run.config), run.stars
    model = model_of(stars, config)
    refuse_stars(run.reader.sample(stars), model, config)
    if stars.in_memory and stars.epoch is not None:
        # only for all stars: a sample may have none in a short segment
        refuse_empty_segments(stars.epoch, model.time)
    earlier = earlier_calibration(model, config, run.base, stars)
    try:
        fitted = _fitted(run, model, config, earlier)
    except (DegenerateError, NotSettledError) as error:
        better = frames_that_help(stars.sample(SAMPLE), model)
        if better is None:
            raise
        raise type(error)(error.cause, where=error.where, do=better.sentence) from error
    refuse_geometry(
        geometries(fitted["fit"]),
        scale_mas=config.detector.scale_mas,
        tangent_point=stars.tangent_point,
        where=", ".join(stars.sources),
    )
    fit = replace(fitted["fit"], tangent_point=stars.tangent_point)
    return run.having(**{**fitted, "fit": fit})


def match_stars(run: Run) -> Run:
    """Divide matched stars into fitted and held-out stars, as configured."""
    config = cast(MatchesConfig, run.config)
    stars: Matches = run.inputs
    files = ", ".join(stars.sources)
    if config.data.sigma == "by_magnitude":
        # These errors are estimated from residuals that the match circle has truncated, so that
        # the likelihood must not correct for the circle a second time.
        if stars.has_nominal:
            log.info("fit: nominal positions are not used with errors by magnitude")
        stars = stars.without_assumed_motions().without(
            "sigma_u", "sigma_v", "rho_uv", "u_nominal", "v_nominal"
        )
    if in_circle(stars, config):
        for fault in config.circle_faults():
            cause, _, do = fault.partition("; ")
            raise ConfigError(cause, where=files, do=do)
    config.mixture(stars.match_radius)  # uniform outliers need a radius
    fitted, held, exposures = set_aside(config, stars)
    return run.having(stars=fitted, held_stars=held, held_exposures=exposures)


def read_stars(config: MatchesConfig, base: Path) -> Matches:
    """Read the matched stars that a configuration names.

    The stars keep the file names relative to `base`, so that a run does not depend on its folder.
    """
    size, block = config.detector.size, config.prior_calibration

    def read(data: Data) -> Matches:
        return read_configured(data.paths(base), data, size=size, chips=config.chip)

    if block is None:
        stars = read(config.data)
    else:
        earlier = _calibration(calibration_file(base / block.source), block.filter)
        frames = block.frame or config.model.frames
        stars = read_on_plane(earlier, config.data, read, frames=frames)
    return stars.named_below(str(base))


def _warnings_of_files(matches: Matches) -> tuple[str, ...]:
    """Notes on files that are probably cut."""
    return tuple(note for note in dict.fromkeys(matches.notes) if "(NEXTEND)" in note)


MATCHES = MatchesKind()


def _fitted(
    run: Run,
    model: DistortionModel,
    config: MatchesConfig,
    earlier: CalibrationPrior | None,
) -> FitArtefacts:
    """Fit with errors by magnitude, or with the quoted errors adjusted to the residuals."""
    stars, reader = run.stars, run.reader
    priors = priors_of(model, config)
    rejection = Rejection(config.fit.clip_chi2, config.fit.clip_abs, config.fit.radial_weight)
    by_magnitude = config.data.sigma == "by_magnitude"

    def begun(priors: GaussianPriors) -> tuple[LinearFit, ErrorLaw]:
        """First fit, with errors by magnitude or with the quoted errors."""
        if by_magnitude:
            linear, _, errors = fit_by_magnitude(
                stars, model, rejection=rejection, priors=priors, compute=reader.compute
            )
            return linear, ErrorLaw(by_magnitude=errors)
        shards = shards_of(stars, model, config, QUOTED, reader)
        return fit_linear(shards, model, rejection=rejection, priors=priors), QUOTED

    if earlier is not None:
        loose = replace(priors, joint=earlier.loose().joint)
        # the covariance is rotated into the frame, which a first fit determines
        turned = earlier.about(begun(loose)[0].mean) if earlier.turns else loose
        priors = replace(priors, joint=turned.joint)
        log.info(
            "fit: the prior is %s, in %d of %d directions",
            *(earlier.name, priors.n_informative, model.n_params),
        )

    def fitted(errors: ErrorLaw) -> LinearFit:
        shards = shards_of(stars, model, config, errors, reader)
        return fit_linear(shards, model, rejection=rejection, priors=priors)

    linear, errors = begun(priors)
    if by_magnitude:
        return {"fit": linear, "errors": errors, "priors": priors}
    factor = error_scale(linear, reader.sample(stars, errors))
    if factor != 1.0:
        errors = ErrorLaw(factor)
        linear = fitted(errors)
    grouped = compared_errors(config, linear, reader.sample(stars, errors), priors)
    if grouped is not None and grouped.added is not None:
        errors = ErrorLaw(factor, added=grouped.added)
        linear = fitted(errors)
    return {"fit": linear, "errors": errors, "priors": priors, "added_errors": grouped}


def compared_errors(
    config: Config, fit: LinearFit, sample: Matches, priors: GaussianPriors
) -> GroupedErrors | None:
    """Errors added to groups of stars, or a single jitter, from a fit with the quoted errors.

    None if groups are not compared: the errors come from the residuals, the jitter is given or is
    to be a single one, or the match circle has truncated the residuals.
    """
    if not config.compares_jitters or in_circle(sample, config):
        return None
    by = config.outliers.jitter_by
    try:
        return grouped_errors(
            sample,
            fit,
            by="" if by == "auto" else by,
            outliers=config.outliers.model != "none",
            priors=priors,
        )
    except DegenerateError as error:
        log.info("fit: one jitter for all stars: groups are not compared, as %s", error.cause)
        return None


def priors_of(model: DistortionModel, config: Config) -> GaussianPriors:
    """Configured priors on the parameters."""
    return GaussianPriors.of(model, {p.parameter: (p.mean, p.sigma) for p in config.prior})


def earlier_calibration(
    model: DistortionModel, config: Config, base: Path, stars: Matches | None = None
) -> CalibrationPrior | None:
    """Prior from the calibration that a configuration names; None if it names none.

    Raises InputError if `stars` are on another tangent plane; see `refuse_other_plane`.
    """
    block = config.prior_calibration
    if block is None:
        return None
    earlier = _calibration(calibration_file(base / block.source), block.filter)
    if stars is not None:
        frames = block.frame or model.frames
        refuse_other_plane(earlier, stars, frames=frames)
        if frames in ("none", "shift") and earlier.plane.point is None and stars.tangent_point:
            log.warning(
                "fit: u and v of the prior %s state no tangent point and are taken to have that of "
                "the stars, %s",
                *(earlier.name, list(stars.tangent_point)),
            )
    return prior_of_calibration(
        earlier,
        model,
        frame=block.frame,
        epoch=block.epoch,
        change_pix=block.change_pix,
    )


def _calibration(path: Path, filter: str | None) -> Calibration:
    """Calibration of a file, or of a run with the errors that its diagnostics found."""
    if path.suffix != ".nc":
        return read_calibration(path, filter=filter)
    if path.name == FIT:
        return calibration_of(load_fit(path), str(path))
    posterior = converged_posterior(path, "it is a prior")
    folder = path.parent
    if path.name == POSTERIOR and (folder / "run.json").exists():
        run = RunDirectory(folder)
        # without the errors found by the diagnostics the prior would be too narrow
        run.require("prior_calibration", ("fit", "sample", "diagnose"))
        fit = load_fit(folder / FIT)
        diagnostics = load_diagnostics(run, fit, posterior)
        hierarchy = hierarchy_of(fit, read_stored_fit(folder)["parts"])
        posterior = with_diagnosed_errors(posterior, diagnostics, hierarchy)
    return calibration_of(posterior, str(folder))
