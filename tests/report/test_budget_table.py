"""Budget of the report: the model's parts jointly, and probabilities near 1 as bounds."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from lxml import html as lxml_html

from bayesdist.assess.budget import BudgetTerm
from bayesdist.report.contents import REPORT
from bayesdist.report.run_report import render_report
from bayesdist.report.sections.budget import budget_table


@pytest.fixture
def anti_correlated(converged):
    """Budget whose two parts of the model, 4 and 3 on each axis, cancel but for 1; beside it 2."""
    budget = converged.evaluation.budget
    one = np.ones_like(budget.total.u)

    def term(name, size, *, of_parameters=False):
        return BudgetTerm(
            name, "systematic", size * one, size * one, "measured", of_parameters=of_parameters
        )

    parts = [term(name, size, of_parameters=True) for name, size in (("fast", 4.0), ("slow", 3.0))]
    total = replace(budget.total, u=np.sqrt(5.0) * one, v=np.sqrt(5.0) * one)
    terms = (*parts, term("catalogue", 2.0))
    return converged.having(budget=replace(budget, terms=terms, total=total, products=()))


def test_parts_of_the_model_jointly_are_what_independent_terms_leave_of_the_total(anti_correlated):
    model = anti_correlated.evaluation.budget.model
    np.testing.assert_allclose([model.u, model.v], 1.0, rtol=1e-12)


def test_the_model_comes_first_and_its_correlated_parts_are_folded(anti_correlated):
    main, parts = budget_table(anti_correlated)
    assert [row[0] for row in main.rows] == ["model, jointly", "catalogue", "total"]
    per_axis = main.columns.index("Per axis [pix]")
    assert [float(row[per_axis].split()[0]) for row in main.rows] == pytest.approx(
        [1, 2, 5**0.5], rel=1e-2
    )
    assert [row[0] for row in parts.rows] == ["fast", "slow"] and parts.folded
    tree = lxml_html.fromstring(render_report(anti_correlated, {}))
    folded = tree.xpath("//section[@id='budget']/details//tbody/tr/th")
    assert [cell.text_content() for cell in folded] == ["fast", "slow"]


def test_the_size_of_a_milliarcsecond_on_a_focal_plane_is_stated(anti_correlated):
    run = anti_correlated.having(configuration={"data": {"plate_scale": 20.0}})
    assert "On the focal plane 1\u202fmas is 0.0500\u202fµm." in budget_table(run)[0].note
    assert "focal plane" not in budget_table(anti_correlated)[0].note


def test_a_single_part_of_the_model_is_a_row_as_it_is(anti_correlated):
    fast, _, catalogue = anti_correlated.evaluation.budget.terms
    budget = replace(anti_correlated.evaluation.budget, terms=(fast, catalogue))
    assert budget.model is None
    (table,) = budget_table(anti_correlated.having(budget=budget))
    assert [row[0] for row in table.rows] == ["fast", "catalogue", "total"]
    assert table.columns[-1] == "Relative uncertainty"


@pytest.mark.parametrize("several", [True, False])
def test_the_map_of_the_dominant_term_is_left_out_where_one_term_dominates(converged, several):
    budget = converged.evaluation.budget
    assert np.count_nonzero(budget.share) > 1
    if not several:
        budget = replace(budget, terms=(budget.terms[int(budget.share.argmax())],))
    items = REPORT.items(converged.having(budget=budget), "figure")
    assert ("budget_dominating" in [item.name for item in items]) == several
