"""Everything that speaks xarray and ArviZ: convergence diagnostics and netCDF files."""
