"""Entry points for people and programs: command line, supervisor, demo, web process."""
