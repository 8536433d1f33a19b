"""bayesdist: how well is the geometric distortion of a detector known?

Everything public is here and is loaded when it is first used::

    import bayesdist as bd
    matches = bd.read_matches("stars.ecsv")
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
