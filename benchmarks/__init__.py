"""Ground truth, quality and speed measurements.

`cli.py` has the commands of `deltalight bench`. Modules with a `main` are run by `python -m` and say at their head
what they measure or make. Each folder belongs to one command, except `ground_truth`, which renders what others
compare with.
"""
