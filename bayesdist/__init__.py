"""bayesdist: the geometric distortion of a detector and its uncertainty.

All public names are available from this module and are imported on first use::

    import bayesdist as bd
    matches = bd.read_matches("stars.ecsv")

Messages go to the logger "bayesdist", which has only a `logging.NullHandler`: programs that want to
show them configure `logging`.  Importing the package has no other effect on the process.
"""

import logging

import lazy_loader

logging.getLogger(__name__).addHandler(logging.NullHandler())

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
