"""The commands of `deltalight`, one a file; heavy imports stand inside, so that --help is quick."""
