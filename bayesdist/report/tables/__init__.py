"""The report's tables, as text."""

from bayesdist.report.tables.assessment import (
    budget_table,
    map_table,
    margin_table,
    rests_on_table,
)
from bayesdist.report.tables.coefficients import coefficient_tables
from bayesdist.report.tables.data import data_tables
from bayesdist.report.tables.fit import (
    added_errors_table,
    fit_tables,
    outlier_table,
    score_test_table,
)
from bayesdist.report.tables.provenance import config_table, provenance_tables
from bayesdist.report.tables.text import TextTable

__all__ = [
    "TextTable",
    "added_errors_table",
    "budget_table",
    "coefficient_tables",
    "config_table",
    "data_tables",
    "fit_tables",
    "map_table",
    "margin_table",
    "outlier_table",
    "provenance_tables",
    "rests_on_table",
    "score_test_table",
]
