"""Writing a recording to a disk that may refuse for a while: what was written is kept, and it goes on by itself."""

import time
from collections.abc import Callable

from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.frames import SensorFrame
from deltalight.protocol.recording_writer import DiskRefusesError, RecordingWriter

RETRY_PERIOD_S = 2.0


class RetryingWriter:
    """Gives frames and relit pictures to a writer; while its disk refuses, it leaves them out and tries again.

    `frames` and `composites` count what is in the file, `unkept` the frames that are not. `notice(sentence)` tells
    when the disk refuses and when it takes data again.
    """

    def __init__(self, writer: RecordingWriter, notice: Callable[[str], None]) -> None:
        self.active_path, self.path = writer.active_path, writer.path
        self.frames = self.composites = self.unkept = 0
        self._writer, self._notice = writer, notice
        self._refusal: DiskRefusesError | None = None
        self._holds_frame = False
        self._unkept_before = 0
        self._tried_s = 0.0

    @property
    def is_refused(self) -> bool:
        """Whether the disk refuses now."""
        return self._refusal is not None

    def add(self, frame: SensorFrame) -> bool:
        """Appends a frame; returns whether it is in the file.

        Raises:
            DiskRefusesError: the disk refuses the first frame.
            DeltalightError: the disk fails.
        """
        if self.is_refused:
            self.unkept += 1
            return False
        try:
            self._writer.add(frame)
        except DiskRefusesError as refusal:
            if not self.frames:
                raise
            self._pause(refusal, holds_frame=True)
            return False
        self.frames += 1
        return True

    def add_composite(self, timestamp_ns: int, picture: bytes) -> None:
        """Appends the relit picture of a frame that is in the file.

        Raises:
            DeltalightError: the disk fails.
        """
        if self.is_refused:
            return
        try:
            self._writer.add_composite(timestamp_ns, picture)
        except DiskRefusesError as refusal:
            self._pause(refusal, holds_frame=False)
        else:
            self.composites += 1

    def try_again(self, *, at_once: bool = False) -> None:
        """If the disk refused and some time has passed, go on if it takes data again.

        Raises:
            DeltalightError: the file was removed or truncated meanwhile, or the disk fails.
        """
        now_s = time.monotonic()
        if not self.is_refused or (now_s - self._tried_s < RETRY_PERIOD_S and not at_once):
            return
        self._tried_s = now_s
        try:
            self._writer.resume()
        except DiskRefusesError:
            return
        self._refusal = None
        self.frames += self._holds_frame
        self.composites += not self._holds_frame
        lost = self.unkept - self._unkept_before
        self._notice(
            f"The disk takes data again, and the recording goes on; {lost} frames could not be kept."
        )

    def end(self) -> None:
        """Tries a last time to write what the disk refused.

        Raises:
            DiskRefusesError: it still refuses.
            DeltalightError: the disk fails.
        """
        self.try_again(at_once=True)
        if self._refusal is not None:
            self.unkept += self._holds_frame
            raise self._refusal

    def _pause(self, refusal: DiskRefusesError, *, holds_frame: bool) -> None:
        self._refusal, self._holds_frame = refusal, holds_frame
        self._unkept_before, self._tried_s = self.unkept, time.monotonic()
        self._notice(
            f"{self.active_path} cannot grow ({reason(refusal)}); its {self.frames} frames are kept, and the"
            " recording goes on once you free space or lift the limit."
        )


def reason(fault: DeltalightError) -> str:
    """Returns what the system says of a fault of the disk, else its sentence."""
    cause = fault.__cause__
    return str(cause.strerror) if isinstance(cause, OSError) else str(fault)
