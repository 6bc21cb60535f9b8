"""The commands of `deltalight`, one per file; heavy imports are inside functions, so that --help is fast."""
