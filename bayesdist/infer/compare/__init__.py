"""Solutions compared: polynomial orders, periods, dates of change, and exposures to come."""
