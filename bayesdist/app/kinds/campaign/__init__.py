"""A campaign: from the star lists of many exposures to released files, as stages of a run."""
