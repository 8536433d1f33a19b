"""Identity of a report: document id, hash of the configuration, and lines to sign."""

from __future__ import annotations

import hashlib
from dataclasses import replace

from lxml import html as lxml_html

from bayesdist.report.run_report import render_report
from bayesdist.report.sections.provenance import config_hash, document_id


def test_the_hash_is_that_of_the_configuration_whatever_the_order_of_keys(converged):
    run = converged.having(configuration={"b": 1, "a": {"d": 2.5, "c": None}})
    text = '{"a": {"c": null, "d": 2.5}, "b": 1}'
    assert config_hash(run) == hashlib.sha256(text.encode()).hexdigest()
    assert config_hash(
        run.having(configuration={"a": {"c": None, "d": 2.5}, "b": 1})
    ) == config_hash(run)


def test_a_document_is_known_by_its_run(converged):
    began = {"created": "2026-11-22T10:58:32+00:00"}
    run = converged.having(title="WFC3 / UVIS", configuration={"a": 1}, provenance=began)
    first = document_id(run)
    assert first.startswith("WFC3-UVIS-20261122-")
    assert document_id(replace(run)) == first  # drawn again
    later = run.having(provenance={"created": "2026-11-22T10:58:33+00:00"})
    assert len({first, document_id(later), document_id(run.having(configuration={"a": 2}))}) == 3


def test_the_report_has_its_id_and_lines_to_sign(converged):
    tree = lxml_html.fromstring(render_report(converged, {}))
    (section,) = tree.xpath("//section[@id='provenance']")
    assert document_id(converged) in section.text_content()
    signed = section.xpath(".//table[caption='Sign-off']//tbody//th")
    assert [cell.text_content() for cell in signed] == ["Prepared", "Reviewed", "Approved"]


def test_legendre_coefficients_are_printed_and_no_others(converged):
    tree = lxml_html.fromstring(render_report(converged, {}))
    (section,) = tree.xpath("//section[@id='coefficients']")
    assert "detail" not in (section.get("class") or "").split()
    folded = section.xpath("./details")
    printed = [one for one in folded if "detail" not in one.get("class").split()]
    assert len(folded) > 1 and len(printed) == 1
    rows = printed[0].xpath(".//tbody/tr")
    names = [n for n in converged.model.names if n not in converged.held_parameters]
    assert {row.xpath("string(./th)") for row in rows} <= set(names)
    polynomial = [p.name for p in converged.model.parameters if p.kind == "polynomial"]
    assert [row.xpath("string(./th)") for row in rows] == [n for n in polynomial if n in names]
    assert not [row for row in rows if "screen" in (row.get("class") or "").split()]
