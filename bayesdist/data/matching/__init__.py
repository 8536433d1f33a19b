"""Detections to reference stars: recognised by patterns, mapped, paired, judged against chance."""
