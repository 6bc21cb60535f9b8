"""Cameras behind one small interface: replayed recordings and a synthetic scene."""
