"""Input: matched positions, reference catalogues, and the matching of star lists with catalogues.

`read_matches` reads any known kind of file.  Each kind has a module of its own, and all of them end
in `Matches`, where units, errors and row numbers have been checked.  Tables that are larger than
the memory are Parquet: `open_matches` leaves them on disk, to be read in batches;
`write_partitioned` makes such files.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
