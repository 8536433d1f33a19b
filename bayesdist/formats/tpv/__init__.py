"""TPV headers: polynomials of intermediate world coordinates, as written by SCAMP."""
