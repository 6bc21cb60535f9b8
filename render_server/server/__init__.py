"""The render server: its process, the session of one scene, incoming frames, and snapshots."""
