"""The render server: its process, the session of one scene, frames in, snapshots out."""
