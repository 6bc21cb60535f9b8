"""`deltalight bench soak`: a station of real processes under faults, watched over time."""
