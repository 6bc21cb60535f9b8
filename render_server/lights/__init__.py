"""Lights of a scene: light models, their sources over time, and maps of all directions."""
