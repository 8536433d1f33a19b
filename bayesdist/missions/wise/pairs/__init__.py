"""RvB pairs: detections of WISE with stars of 2MASS, their files, and those of a run."""
