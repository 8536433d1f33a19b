"""HST/ACS: a simulated campaign, published linear terms, and the figures of its handbook."""

from bayesdist.plugin import Mission, Plugin

__all__ = ["PLUGIN"]

_LISTS = "bayesdist.formats.hst1pass"
_COMMANDS = "bayesdist.missions.hst.commands"

PLUGIN = Plugin(
    missions={
        "hst": Mission(
            title="HST: handbook figures and pixel area maps.",
            commands={"handbook": f"{_COMMANDS}:handbook", "pam": f"{_COMMANDS}:pam"},
            simulate={"acs": f"{_COMMANDS}:simulate"},
            match_formats={"matchup": f"{_LISTS}:MATCHUP", "hst1pass": f"{_LISTS}:HST1PASS"},
            releases={"hst": "bayesdist.missions.hst.release:RELEASE"},
        )
    },
    reports=("bayesdist.missions.hst.published",),
)
