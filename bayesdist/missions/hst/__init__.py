"""HST/ACS: a simulated campaign, published linear terms, and the figures of its handbook."""

from bayesdist.plugin import Mission, Plugin

__all__ = ["PLUGIN"]

_COMMANDS = "bayesdist.missions.hst.commands"

PLUGIN = Plugin(
    missions={
        "hst": Mission(
            title="HST: handbook figures and pixel area maps.",
            commands={"handbook": f"{_COMMANDS}:handbook", "pam": f"{_COMMANDS}:pam"},
            simulate={"acs": f"{_COMMANDS}:simulate"},
            report="bayesdist.missions.hst.published",
        )
    }
)
