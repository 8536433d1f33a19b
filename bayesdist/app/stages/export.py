"""Stage 4: files for pipelines."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from typing import Any

from bayesdist.app.made_files import made_files
from bayesdist.app.session import Session
from bayesdist.app.sky_closure import sky_closure
from bayesdist.assess.budget.budget import with_product
from bayesdist.assess.terms.forms import PRODUCT
from bayesdist.files import atomic_path
from bayesdist.limits import FILE_ERROR
from bayesdist.products.registry import lint

__all__ = ["run_export"]

log = logging.getLogger("bayesdist")


def run_export(session: Session, written: Sequence[dict[str, Any]] = ()) -> None:
    """Write what the configuration asks for; `written` is what there is already."""
    run = session.run
    products: list[dict[str, Any]] = [*written]
    for files in made_files(session, session.solution).values():
        for built in files:
            path = run / built.file_name
            with atomic_path(path) as temporary:
                temporary.write_bytes(built.content)
            entry: dict[str, Any] = {"path": built.file_name, "kind": built.kind}
            if built.chip is not None:
                entry["chip"] = built.chip
            findings = [f"{f.level}: {f.where}: {f.message}" for f in lint(path)]
            sky = None if built.chip is None else sky_closure(session, path, built.chip)
            if sky is not None:
                entry["sky"] = sky.summary
                log.log(sky.level, "export: %s: %s", path.name, sky.sentence)
                findings += sky.findings
            products.append(entry | built.summary | {"findings": findings})
    for product in products:
        _compare(product, run.summary.get("budget", []))
    run.summarise(products=products)
    log.info("export: %s", ", ".join(p["path"] for p in products) or "no products asked for")


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
