"""Files of results: tables, arrays and sections of summary.json."""
