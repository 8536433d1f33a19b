"""Input data: matched positions, reference catalogues, and matching of star lists.

`read_matches` reads files of all supported kinds. All of them end in `Matches`, after units, errors
and row numbers have been checked. Tables larger than memory are stored as Parquet: `open_matches`
leaves them on disk, to be read in batches, and `write_partitioned` writes such files.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
