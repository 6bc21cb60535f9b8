"""Lights of a scene: what shines, where it comes from from frame to frame, and maps of all directions."""
