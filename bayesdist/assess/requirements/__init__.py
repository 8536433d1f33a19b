"""Requirements, margins with their probabilities, verdicts, and how long they hold."""
