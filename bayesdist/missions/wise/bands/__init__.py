"""`bayesdist wise bands`: tables and figures that compare several bands."""
