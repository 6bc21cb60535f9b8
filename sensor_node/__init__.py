"""Capture: cameras, depth clean-up, marker poses, and the loop of a sensor node."""
