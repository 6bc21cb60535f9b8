"""How well relighting agrees with ground truth: `deltalight bench quality`."""
