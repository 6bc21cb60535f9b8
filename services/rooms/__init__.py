"""Rooms: several render sessions on one installation, where each of them runs, and who follows them."""
