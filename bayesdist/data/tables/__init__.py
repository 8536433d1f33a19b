"""Files with columns: read whole or block by block, columns found by name and brought to arrays."""
