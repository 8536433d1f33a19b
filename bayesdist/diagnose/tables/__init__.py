"""What look-up tables leave between their nodes."""
