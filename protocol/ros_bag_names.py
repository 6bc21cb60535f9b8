"""How ROS bags are told from recordings and dataset folders, by their names alone."""

from pathlib import Path

from deltalight.protocol.errors import DeltalightError

BAG_SUFFIX = ".bag"  # of a ROS 1 bag
BAG_METADATA, BAG_DATABASE = "metadata.yaml", ".db3"  # of a ROS 2 bag


def refuse_bag(path: Path) -> None:
    """Refuses a ROS 1 bag where a recording or a dataset folder is needed.

    Raises:
        DeltalightError: it is one, by its name.
    """
    if path.suffix.lower() == BAG_SUFFIX:
        raise DeltalightError(
            f"{path} is a ROS bag; make a recording of it with `deltalight recordings import`."
        )
