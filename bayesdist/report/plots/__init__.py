"""Plots of single results for notebooks and scripts; the report draws with the same functions.

Each function takes the object that it shows and `ax`, draws into these axes and returns them.
Without `ax` it makes a new figure with matplotlib.pyplot.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
