"""The GPU pipeline and the process that serves it; start reading at renderer.py."""
