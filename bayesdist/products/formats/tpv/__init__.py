"""TPV headers: polynomials of intermediate world coordinates, as SCAMP writes them."""
