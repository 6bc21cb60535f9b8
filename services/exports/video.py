"""The relit pictures of a recording as a video."""

from pathlib import Path

from deltalight.protocol.counts import counted
from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.pictures import decode_rgb
from deltalight.protocol.source import Source
from deltalight.services.recording_copies import Copied, Track
from deltalight.services.video_file import VIDEO_SUFFIX, video_file


def export_video(source: Source, out: Path, track: Track) -> Copied:
    """Writes the relit pictures that were recorded along.

    Raises:
        DeltalightError: PyAV is missing, there are no such pictures, `out` is taken, or the disk refuses.
    """
    if out.suffix != VIDEO_SUFFIX:
        raise DeltalightError(f"{out} must end in {VIDEO_SUFFIX}; choose another name.")
    without = 0
    with video_file(out, source.timestamps_ns) as video:
        for index in track(range(len(source))):
            frame = source[index]
            if frame.composite is None:
                without += 1
            else:
                name = f"of frame {frame.frame_id}"
                video.add(decode_rgb(frame.composite, name), frame.timestamp_ns)
        if without == len(source):
            raise DeltalightError(
                "No relit picture was recorded; record with --composites, or render the recording to NAME.mp4."
            )
    note = [f"Left out: {counted(without, 'frame')} without a relit picture."] if without else []
    return Copied(out, video.frames, notes=[*source.notes, *note])
