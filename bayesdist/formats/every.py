"""Functions for files of every format, defined in `bayesdist.products.registry`."""

from bayesdist.products.registry import (
    describe as describe,
)
from bayesdist.products.registry import (
    lint as lint,
)
from bayesdist.products.registry import (
    list_formats as list_formats,
)
