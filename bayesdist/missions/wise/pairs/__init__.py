"""RvB pairs (detections of WISE matched with stars of 2MASS): files, selection, and run input."""
