"""Functions that implement members of `Run` in modules that import `Run`.

`Run` cannot import these modules.  Its members import the functions by name when they are called.
"""

DIAGNOSE = "bayesdist.app.diagnosing:diagnostics_of_run"
CHECKS = "bayesdist.app.evaluating:checks_of_run"
ERROR_MODEL = "bayesdist.app.evaluating:error_model_of_run"
SETTINGS = "bayesdist.app.evaluating:evaluation_settings"
EVALUATE = "bayesdist.app.evaluating:evaluation_of_run"
MARGINS = "bayesdist.app.evaluating:margins_of_run"
DRAWN_ERRORS = "bayesdist.app.evaluating:drawn_errors_of_run"
CALIBRATION = "bayesdist.app.questions:calibration_of_run"
BUDGET = "bayesdist.app.questions:budget_of_run"
MAP = "bayesdist.app.questions:map_of_run"
PLOT = "bayesdist.app.questions:plots_of_run"
WCS = "bayesdist.app.questions:wcs_of_run"
TO_SKY = "bayesdist.app.questions:positions_on_sky"
TEXT = "bayesdist.app.questions:text_of_run"
HTML = "bayesdist.app.questions:html_of_run"
PREVIOUS = "bayesdist.app.report:comparison_with_previous"
REPORT = "bayesdist.app.report:write_html_report"
SAVE = "bayesdist.app.runs:save_run"
