"""Result files: tables, arrays and sections of summary.json."""
