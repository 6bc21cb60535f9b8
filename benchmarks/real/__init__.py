"""`bench real`: relighting compared with photographs taken with and without an object."""
