"""The format "rvb" of a run."""

from bayesdist.app.matches.sources import MatchSource
from bayesdist.missions.wise.pairs.run_input import RvbInput, load_rvb
from bayesdist.missions.wise.pairs.template import rvb_template

__all__ = ["SOURCE"]

SOURCE = MatchSource(read=load_rvb, input_of=RvbInput, template=rvb_template)
