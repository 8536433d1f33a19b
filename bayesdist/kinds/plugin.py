"""Entry point of the kinds of runs, and of the commands that only one kind has."""

from bayesdist.plugin import Plugin

PLUGIN = Plugin(
    kinds={
        "data": "bayesdist.kinds.matches.config:MatchesConfig",
        "campaign": "bayesdist.kinds.campaign.config:CampaignConfig",
        "selfcal": "bayesdist.kinds.selfcal.config:SelfcalConfig",
    },
    reports=("bayesdist.kinds.campaign.report", "bayesdist.kinds.selfcal.report"),
    first_commands={"init": "bayesdist.kinds.commands:init"},
    commands={
        "plan-dither": "bayesdist.kinds.commands:plan_dither",
        "release": "bayesdist.kinds.commands:release",
    },
)
