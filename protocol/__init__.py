"""Everything that crosses a process boundary or is written to disk."""
