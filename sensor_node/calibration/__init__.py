"""Calibration from pictures of a flat target: lenses, transforms between sensors, response, paper."""
