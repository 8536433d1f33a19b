"""Look-up tables from residuals: node values and their errors, fitted together with a polynomial.

`field_table` models the node values as a Gaussian random field; `binned_table` averages residuals
in bins as in Kozhurina-Platais et al. (2015). `fit_with_tables` alternates either of them with the
polynomial fit.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
