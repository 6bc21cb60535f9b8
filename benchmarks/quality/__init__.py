"""Agreement of relighting with ground truth: `deltalight bench quality`."""
