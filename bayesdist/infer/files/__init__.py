"""Solutions as netCDF files: fit.nc and posterior.nc."""
