"""Table files: reading whole files or blocks, finding columns by name, and conversion to arrays."""
