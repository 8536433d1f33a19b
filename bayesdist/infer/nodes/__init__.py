"""Look-up tables from residuals: node values, their errors, and the polynomial that goes with them.

`field_table` models the nodes as a Gaussian random field, `binned_table` is the way of ACS ISR
2015-06; `fit_with_tables` runs either in turn with the polynomial fit.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
