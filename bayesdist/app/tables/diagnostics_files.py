"""Diagnostics of a run in its folder: written by `diagnose`, read by whatever follows."""

from __future__ import annotations

import hashlib
import logging
from dataclasses import asdict
from typing import Any

import numpy as np

from bayesdist.app.store.keys import attributes
from bayesdist.app.store.rundir import RunDirectory
from bayesdist.diagnose.diagnostics import Diagnostics
from bayesdist.diagnose.residuals.misfit import Misfit
from bayesdist.diagnose.score.result import ScoreTest
from bayesdist.errors import FormatError, InputError, required
from bayesdist.files.records import read_record, write_record
from bayesdist.infer import LinearFit, Posterior

FILE = "diagnostics.h5"

log = logging.getLogger("bayesdist")


def fingerprint_of(fit: LinearFit, posterior: Posterior) -> str:
    """Hash of the numbers of a fit and of the posterior's draws, to which a file belongs."""
    digest = hashlib.sha256()
    for values in (fit.mean, fit.cov, posterior.theta):
        digest.update(np.ascontiguousarray(values).tobytes())
    return digest.hexdigest()


def write_diagnostics(
    run: RunDirectory, fit: LinearFit, posterior: Posterior, found: Diagnostics
) -> None:
    """Write diagnostics of a fit and a posterior, and their sections of summary.json."""
    correlated = required(found.correlated, "correlated errors are diagnosed of a posterior only")
    write_record(run / FILE, found, fingerprint_of(fit, posterior))
    facts = correlated.facts
    run.summarise(
        discrepancy=dict(facts),
        score_tests=[_row(test) for test in found.score_tests],
        misfit=_misfit_summary(found),
    )
    for row in facts.get("structure", []):
        log.info(
            "diagnose: structure beyond the model on chip %s, %s: %.2g %s rms, at most %.2g with "
            "95 %% probability",
            *(row["chip"], row["axis"], row["median"], facts["unit"], row["most"]),
        )
    for test in found.score_tests:
        if test.significant:
            log.info("diagnose: %s: %s", test.finding, test.remedy)


def load_diagnostics(run: RunDirectory, fit: LinearFit, posterior: Posterior) -> Diagnostics | None:
    """Diagnostics of a fit and a posterior; None where there are none of just these."""
    if not (run / FILE).exists():
        return None
    again = f"run 'bayesdist stage diagnose {run.path}' again"
    mark = fingerprint_of(fit, posterior)
    try:
        return read_record(run / FILE, Diagnostics, "diagnostics", do=again, fingerprint=mark)
    except FormatError:
        raise
    except InputError:  # of another fit or posterior
        return None


def _row(test: ScoreTest) -> dict[str, Any]:
    """A test as a row of summary.json."""
    row = asdict(test)
    del row["held_by"]
    # JSON has no infinity: what no effect can show has no smallest size
    return row | {"smallest": test.smallest if np.isfinite(test.smallest) else None}


def _misfit_summary(found: Diagnostics) -> dict[str, Any]:
    worst = found.misfit
    out = _misfit_row(worst) | {"unit": worst.unit, "significant": worst.significant}
    if len(found.misfits) > 1:
        out["chips"] = [_misfit_row(m) for m in found.misfits]
    return out


def _misfit_row(m: Misfit) -> dict[str, Any]:
    row = attributes(m, "p_value partition structure power")
    return row if m.chip is None else row | {"chip": m.chip.number}
