"""Ground truth, quality and speed measurements."""
