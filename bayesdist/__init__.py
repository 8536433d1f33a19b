"""bayesdist: how well is the geometric distortion of a detector known?

Everything public is here and is loaded when it is first used::

    import bayesdist as bd
    matches = bd.read_matches("stars.ecsv")

Messages go to the logger "bayesdist", which has no handler of its own: a program that wants them
configures `logging`.  Importing the package changes nothing else in the process.
"""

import logging

import lazy_loader

logging.getLogger(__name__).addHandler(logging.NullHandler())

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
