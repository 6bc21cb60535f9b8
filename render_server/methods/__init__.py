"""One relighting method a file; each reads top to bottom as the list of its stages."""
