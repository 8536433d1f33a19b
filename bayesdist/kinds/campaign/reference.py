"""Detector tables and drift that a run takes over from the run of the reference filter."""

from __future__ import annotations

from pathlib import Path

from bayesdist.app.artefacts.parts import read_tables
from bayesdist.app.artefacts.stored_fit import converged_posterior
from bayesdist.app.config import Config
from bayesdist.app.config.model import TablesBlock
from bayesdist.app.config.run import TABLES, rates_file, tables_file
from bayesdist.errors import InputError
from bayesdist.infer import GaussianPriors
from bayesdist.infer.exposures.shared_drift import drift_priors
from bayesdist.kinds.campaign.linear_terms import with_gap
from bayesdist.model import Chip, DistortionModel, LookupTable
from bayesdist.products.registry import open_document


def held_tables(block: TablesBlock, chips: tuple[Chip, ...], base: Path) -> tuple[LookupTable, ...]:
    """Look-up tables of the detector that are held fixed; empty if the configuration names none.

    Raises InputError if any of `chips` has no table.
    """
    if block.detector is None:
        return ()
    path = tables_file(base / block.detector)
    if path.name == TABLES:
        stored = read_tables(path, do="run its stage 'fit' again").tables
        tables = tuple(table for table in stored if not table.filter)
    else:
        tables = open_document(path).tables()
    have = {table.chip for table in tables}
    missing = [chip.name for chip in chips if chip.number not in have]
    if missing:
        raise InputError(
            f"there is no table of the detector for chip {missing[0]}",
            where=str(path),
            do="name the run or the file of tables of this detector in tables.detector",
        )
    numbers = {chip.number for chip in chips}
    ours = (table for table in tables if table.chip in numbers)
    return tuple(sorted(ours, key=lambda table: table.chip))


def rate_priors(config: Config, model: DistortionModel, base: Path) -> GaussianPriors | None:
    """Priors on the drift of a model from the posterior of another run; None if it is free."""
    tdd, chip = config.model.tdd, config.chips()[0].number
    if tdd is None or config.has_free_rates:
        return None
    path = rates_file(base / tdd.rates)
    posterior = converged_posterior(path, "its rates are used")
    try:
        named = drift_priors(posterior, model, chip=chip)
    except InputError as error:
        raise InputError(error.cause, where=str(path.parent), do=error.do) from error
    return GaussianPriors.of(model, named)


def rehearse_references(config: Config, unit: str, base: Path) -> None:
    """Read everything that a run takes over from other runs, without fitting."""
    chips = config.chips()
    held_tables(config.tables, chips, base)
    if not config.has_free_rates:
        model = with_gap(DistortionModel(config.model.order, chips, unit, config.time()))
        rate_priors(config, model, base)
