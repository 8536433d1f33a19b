"""Public names and the modules that define them; each is imported on first use."""

from .formats.common.document import (
    Choice as Choice,
    Document as Document,
    Finding as Finding,
    Format as Format,
)
from .formats.idctab.build import idctab_from_solution as idctab_from_solution
from .formats.idctab.lint import lint_idctab as lint_idctab
from .formats.idctab.table import (
    IdcTab as IdcTab,
    read_idctab as read_idctab,
    write_idctab as write_idctab,
)
from .formats.lookup.d2im import (
    read_d2im as read_d2im,
    write_d2im as write_d2im,
)
from .formats.lookup.file import (
    LookupFile as LookupFile,
    read_lookup_file as read_lookup_file,
    write_lookup_file as write_lookup_file,
)
from .formats.lookup.lint import lint_lookup_file as lint_lookup_file
from .formats.lookup.npol import (
    read_npol as read_npol,
    write_npol as write_npol,
)
from .formats.sip.build import sip_from_solution as sip_from_solution
from .formats.sip.header import (
    SipHeader as SipHeader,
    worst_closure as worst_closure,
)
from .formats.sip.implied import (
    Implied as Implied,
    implied_values as implied_values,
)
from .formats.sip.lint import lint_sip as lint_sip
from .formats.sip.read import read_sip as read_sip
from .formats.sip.rotate import rotated_sip as rotated_sip
from .formats.sip.write import (
    sip_header as sip_header,
    write_sip as write_sip,
)
from .formats.wise.build import write_wise_meta as write_wise_meta
from .formats.wise.lint import lint_wise_band as lint_wise_band
from .formats.wise.meta import (
    WiseBand as WiseBand,
    read_wise_meta as read_wise_meta,
)
from .maps_file import write_pam as write_pam
from .registry import (
    describe as describe,
    lint as lint,
    list_formats as list_formats,
    open_document as open_document,
    read_calibration as read_calibration,
)
from .release import (
    Period as Period,
    Release as Release,
    write_release as write_release,
)
