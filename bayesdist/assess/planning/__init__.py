"""What further exposures would give: how many are needed, and which dithers are best."""
