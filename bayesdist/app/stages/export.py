"""Stage 'export': files for pipelines."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from bayesdist.app.config import Config
from bayesdist.app.error_terms import published_tables
from bayesdist.app.exposures.release_files import write_files
from bayesdist.app.kinds.fitted import Fitted
from bayesdist.app.made_files import ProductInput, made_files
from bayesdist.app.results import Results
from bayesdist.app.sky_closure import sky_closure
from bayesdist.assess.budget.budget import with_product
from bayesdist.assess.terms.forms import PRODUCT
from bayesdist.diagnose.residuals.sample import StarSample
from bayesdist.files import atomic_path
from bayesdist.limits import FILE_ERROR
from bayesdist.products.registry import lint

__all__ = ["export_files", "run_export"]

log = logging.getLogger("bayesdist")


def run_export(results: Results) -> Results:
    """Write what the configuration asks for into the run's folder."""
    run, config, product = results.run, results.config, results.product
    on_sky = product.tangent_point is not None and config.products.asked()
    products = export_files(
        product,
        results.fitted,
        config,
        results.base,
        run.path,
        stars=results.diagnostics.sample if on_sky else None,
        budget=run.summary.get("budget", []),
    )
    run.summarise(products=products)
    log.info("export: %s", ", ".join(p["path"] for p in products) or "no products asked for")
    return results


def export_files(
    product: ProductInput,
    fitted: Fitted,
    config: Config,
    base: Path,
    folder: Path,
    *,
    stars: StarSample | None = None,
    budget: Sequence[dict[str, Any]] = (),
) -> list[dict[str, Any]]:
    """Write the files that a configuration asks for.

    Parameters
    ----------
    product : ProductInput
        What they are made from.
    fitted : Fitted
    config : Config
    base : Path
        Folder that its files are relative to.
    folder : Path
        Where they are written.
    stars : StarSample, optional
        Stars with which headers are compared on the sky.
    budget : sequence of dict
        Rows of the error budget, with which the errors of files are compared.

    Returns
    -------
    list of dict
        One entry for each file: path, kind, findings, and what else is known of it.
    """
    products: list[dict[str, Any]] = []
    if config.products.release is not None:
        held = config.tables.detector is not None
        tables = published_tables(fitted.tables, held=held)
        products += write_files(config, base, folder, {product.filter: product.solution}, tables)
    for files in made_files(product, config).values():
        for built in files:
            path = folder / built.file_name
            with atomic_path(path) as temporary:
                temporary.write_bytes(built.content)
            entry: dict[str, Any] = {"path": built.file_name, "kind": built.kind}
            findings = [f"{f.level}: {f.where}: {f.message}" for f in lint(path)]
            if built.chip is not None:
                entry["chip"] = built.chip
                sky = None if stars is None else sky_closure(product, stars, path, built.chip)
                if sky is not None:
                    entry["sky"] = sky.summary
                    log.log(sky.level, "export: %s: %s", path.name, sky.sentence)
                    findings += sky.findings
            products.append(entry | built.summary | {"findings": findings})
    for one in products:
        _compare(one, budget)
    return products


def _compare(product: dict[str, Any], budget: Sequence[dict[str, Any]]) -> None:
    """Note what the budget says of a file, and what the total is for whoever uses it."""
    for row in budget:
        files, _, direction = row["name"].rpartition(", ")
        path = product["path"]
        if row["kind"] != PRODUCT or not (
            path in files.split(", ") or path.startswith(f"{files}_")
        ):
            continue
        product[f"{direction}_rms"] = row["radial"]
        total = budget[-1]["radial"]
        if direction == "forward":
            product["total_rms"] = with_product(total, row["radial"])
            if row["radial"] > FILE_ERROR.value * total:
                product["findings"].append(
                    f"warning: forward: differs from the solution by {row['radial']:.2g} rms over "
                    f"the detector, whose total error is {total:.2g}"
                )
