"""What people and programs start: command line, supervisor, demo, web process."""
