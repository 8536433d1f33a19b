"""What varies from exposure to exposure: frames, chip offsets, trends."""
