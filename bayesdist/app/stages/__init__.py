"""The stages of a run: each makes an artefact, and writes it into the run's folder."""
