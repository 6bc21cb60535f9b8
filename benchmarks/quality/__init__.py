"""Agreement of relighting with ground truth: `deltalight bench quality`."""

REPORT_KIND = "deltalight quality report"
"""Tells quality.json from other files."""
