"""Camera tracking by other systems, in place of the marker board."""
