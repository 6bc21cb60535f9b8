"""`deltalight gpu-check`: what a machine's GPU and driver make of Deltalight, in steps that cannot end each other."""
