"""Persistent data: scenes with every revision, uploaded assets, tokens. Use it through `store.Store`."""
