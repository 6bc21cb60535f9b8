"""Recordings and scenes in the formats of other programs: COLMAP, Nerfstudio, glTF, ROS bags, video."""

from enum import StrEnum


class ExportFormat(StrEnum):
    """What `recordings export` writes."""

    DATASET = "dataset"
    COLMAP = "colmap"
    NERFSTUDIO = "nerfstudio"
    GLB = "glb"
    ROS1 = "ros1"
    ROS2 = "ros2"
    MP4 = "mp4"
