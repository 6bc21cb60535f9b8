"""Keeps what pictures show of the real scene's albedo for when the camera looks elsewhere (METHOD 2)."""

from protocol.frames import ViewFrame
from render_server.estimation.backoff_schedule import BackoffSchedule
from render_server.gpu.context import GpuContext
from render_server.light_registration import observe_albedo
from render_server.light_samples import Relight
from render_server.passes.unseen_albedo import UnseenAlbedo
from render_server.relight.frame import RelightInput
from render_server.scene.albedo_volume import MEAN_ALBEDO, AlbedoVolume


class AlbedoWatch:
    """The albedo memory of one real scene and its texture; looks again when the camera or the room has moved.

    With a given albedo there is nothing to look at.
    """

    def __init__(self, gpu: GpuContext) -> None:
        self.texture = UnseenAlbedo(gpu)
        self._memory = AlbedoVolume()
        self._interval = BackoffSchedule()
        self._is_given = False

    def look(self, frame: ViewFrame, scene: RelightInput, relight: Relight) -> bool:
        """Take over what this frame shows, if it is time; returns whether the texture changed."""
        if self._is_given or not self._interval.is_due(frame.timestamp_ns):
            return False
        observe_albedo(frame, scene, self._memory, relight)
        self.texture.upload(self._memory)
        return True

    def begin(self, given: float | None) -> None:
        """Begin anew: another real scene."""
        self._memory, self._interval = AlbedoVolume(), BackoffSchedule()
        self._is_given = given is not None
        self.texture.clear(MEAN_ALBEDO if given is None else given)

    def release(self) -> None:
        """Free the texture."""
        self.texture.release()
