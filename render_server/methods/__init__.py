"""Relighting methods: one per file, each a list of its stages."""
