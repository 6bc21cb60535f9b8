"""Examples that the help of a command ends with."""

EXAMPLES = {
    "render": (
        "deltalight render take.mcap -o pictures",
        "deltalight render take.mcap -o pictures --scene scene.json --method dlpv --frames 0:30",
    ),
    "demo": ("deltalight demo", "deltalight demo --headless --frames 30 -o pictures"),
    "precompute": ("deltalight precompute scene.json",),
    "node": ("deltalight node --source synthetic", "deltalight node --source take.mcap"),
    "server": ("deltalight server --scene scene.json",),
    "up": (
        "deltalight up --source synthetic",
        "deltalight up --source take.mcap --scene scene.json",
        "deltalight up --rooms rooms.yaml",
        "deltalight up --rooms rooms.yaml --placer ray --ray-address auto",
    ),
    "record": ("deltalight record -o take.mcap --duration 10",),
    "replay": ("deltalight replay take.mcap",),
    "backup": ("deltalight backup station.zip",),
    "restore": ("deltalight restore station.zip",),
    "foxglove": ("deltalight foxglove", "deltalight foxglove --port 8766"),
    "config": ("deltalight config",),
    "doctor": ("deltalight doctor",),
    "graph": ("deltalight graph", "deltalight graph --method dlpv"),
    "schema": ("deltalight schema scene",),
    "board": ("deltalight board -o board.pdf",),
    "virtual_camera": ("deltalight virtual-camera --device /dev/video10",),
    "stream": (
        "deltalight stream --to rtsp://media.example:8554/room",
        "deltalight stream --to rtmp://media.example/live/room",
    ),
    "ping": ("deltalight ping tcp://127.0.0.1:5603",),
}


def examples_of(command: str) -> str:
    """Returns the examples of a command as the end of its help; blank lines keep them apart."""
    return "\n\n".join(["[bold]Examples[/bold]", *(f"  {line}" for line in EXAMPLES[command])])
