"""Entry point of WISE: its commands, file formats and simulations."""

from bayesdist.plugin import Mission, Plugin

_COMMANDS = "bayesdist.missions.wise.commands"
_PAIRS = "bayesdist.missions.wise.pairs"

PLUGIN = Plugin(
    formats={"wise_meta": "bayesdist.missions.wise.meta_data.format:FORMAT"},
    missions={
        "wise": Mission(
            title="WISE: comparison of bands, RvB pairs, and files.",
            commands={
                "bands": f"{_COMMANDS}:bands",
                "bring-up": f"{_COMMANDS}:bring_up",
                "rotate": f"{_COMMANDS}:rotate",
                "rvb": f"{_COMMANDS}:rvb",
            },
            simulate={"wise": f"{_COMMANDS}:simulate"},
            data_sections={"rvb": f"{_PAIRS}.section:RvbData"},
            match_sources={"rvb": f"{_PAIRS}.run_input:SOURCE"},
            checks={"sip": "bayesdist.missions.wise.meta_data.implied:wrong_coefficient"},
            beside_core={"demo": f"{_COMMANDS}:demo"},
        )
    },
)
