"""`deltalight bench rooms`: how long rooms are away when what shows them is killed, moved or drained."""
