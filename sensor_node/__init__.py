"""Capture: cameras, depth clean-up, marker pose and the loop of a sensor node."""
