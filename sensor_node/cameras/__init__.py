"""Cameras behind one interface: live devices, replayed recordings and a synthetic scene."""
