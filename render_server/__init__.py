"""The GPU pipeline and the process that serves it; renderer.py is where to start reading."""
