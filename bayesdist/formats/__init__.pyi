"""Public names and the modules that define them; each is imported on first use."""

from .every import (
    describe as describe,
    lint as lint,
    list_formats as list_formats,
)
from .hst1pass import (
    read_hst1pass as read_hst1pass,
    read_matchup as read_matchup,
)
from .idctab.build import idctab_from_solution as idctab_from_solution
from .idctab.table import (
    IdcTab as IdcTab,
    read_idctab as read_idctab,
    write_idctab as write_idctab,
)
from .lookup.tables import (
    read_d2im as read_d2im,
    read_npol as read_npol,
    write_d2im as write_d2im,
    write_npol as write_npol,
)
from .sip.build import sip_from_solution as sip_from_solution
from .sip.header import SipHeader as SipHeader
from .sip.files import (
    read_sip as read_sip,
    write_sip as write_sip,
)
