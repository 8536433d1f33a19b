"""Public names and the modules that define them; each is imported on first use."""

from .common.document import (
    Choice as Choice,
    Document as Document,
    Finding as Finding,
    Format as Format,
)
from .maps_file import write_pam as write_pam
from .registry import (
    describe as describe,
    lint as lint,
    list_formats as list_formats,
    open_document as open_document,
    read_calibration as read_calibration,
)
