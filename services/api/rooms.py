"""The rooms of a web process: for each its link to the render server, its viewers and listeners, and its scene."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass

from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.keys import Keys
from deltalight.protocol.messages import CamerasMessage, CompositeMessage, Message, StatsMessage
from deltalight.protocol.scene import SceneDocument
from deltalight.services.api.camera_finder import CameraFinder
from deltalight.services.api.context import Context
from deltalight.services.api.credentials import Tickets
from deltalight.services.api.event_relay import EventRelay
from deltalight.services.api.events import EventHub
from deltalight.services.api.fisheye import FisheyeView
from deltalight.services.api.limits import StreamLimits
from deltalight.services.api.live_hub import LiveHub
from deltalight.services.api.metrics import Metrics
from deltalight.services.api.models import ProcessAnswer
from deltalight.services.api.playback_client import Position
from deltalight.services.api.pools import make_pools
from deltalight.services.api.problems import Problems
from deltalight.services.api.recording_session import RecordingSession, RecordingSessions
from deltalight.services.api.recording_store import RecordingStore
from deltalight.services.api.recording_videos import RecordingVideos
from deltalight.services.api.render_link import RenderLink
from deltalight.services.api.replay_control import ReplayControl
from deltalight.services.api.room_metrics import RoomMetrics
from deltalight.services.api.routes import recordings
from deltalight.services.api.settings import ApiSettings
from deltalight.services.api.snapshot_store import SnapshotStore
from deltalight.services.api.streams import ProcessWatch, Sink, Streams
from deltalight.services.api.whep import WhepSessions
from deltalight.services.host_store import activate_first
from deltalight.services.rooms.directory import DirectoryClient
from deltalight.services.rooms.follower import RoomFollower
from deltalight.services.rooms.status import RoomEndpoints, RoomList, RoomStatus
from deltalight.services.storage.store import Store

ONLY_ROOM = "room"
RENDER_SERVER = "render-server"  # the name of a single one unless its settings give another


@dataclass(frozen=True)
class Room:
    """One room, and the streams of its render server and nodes."""

    context: Context
    streams: Streams
    metrics: RoomMetrics
    nodes: tuple[str, ...] = ()  # endpoints

    def follow(self, endpoints: RoomEndpoints | None) -> None:
        """Uses another render server from now on, None = there is none."""
        self.metrics.note_replaced(self.context.room)
        published = () if endpoints is None else (endpoints.publish,)
        self.streams.follow((*published, *self.nodes))
        self.context.recording_sessions.use_endpoints((*published, *self.nodes))
        if endpoints is None:
            self.context.link.follow(None, None)
        else:
            self.context.link.follow(endpoints.control, endpoints.epoch)

    def close(self) -> None:
        """Ends its children and connections."""
        self.context.replay.close()
        self.context.recording_sessions.close()
        self.streams.close()
        self.context.link.close()


class Rooms:
    """All rooms of a web process: those of a directory, else a single one. The caller closes the store.

    Raises:
        DeltalightError: the directory does not answer.
    """

    def __init__(self, settings: ApiSettings, store: Store, keys: Keys | None) -> None:
        self.metrics = RoomMetrics(
            self._newest, lambda: 0 if self.follower is None else self.follower.refused
        )
        self._builder = _Builder(settings, store, keys, self.metrics)
        self.directory: DirectoryClient | None = None
        self.follower: RoomFollower | None = None
        if settings.rooms is None:
            self._rooms = {ONLY_ROOM: self._builder.single()}
        else:
            self.directory = DirectoryClient(settings.rooms, keys)
            found = self.directory.rooms()
            self._rooms = self._found(found)
            self.follower = RoomFollower(self.directory, self._follow, self._announce)
            self.follower.newest = found  # until it has asked, too
        contexts = [room.context for room in self._rooms.values()]
        for context in contexts:
            context.others.extend(other for other in contexts if other is not context)
            context.events.others = [other.events for other in context.others]
        self._relay = EventRelay(store.feed(), self.contexts)

    @property
    def contexts(self) -> dict[str, Context]:
        """The context of each room by name; that of the first is also used where a request names none."""
        return {name: room.context for name, room in self._rooms.items()}

    def start(self) -> None:
        """Starts to talk to nodes, render servers and other web processes."""
        self._relay.start()
        for room in self._rooms.values():
            room.context.link.start()
            room.streams.start()
        if self.follower is not None:
            self.follower.start()

    def close(self) -> None:
        """Ends all children and connections."""
        if self.follower is not None:
            self.follower.close()
        self._relay.close()
        for room in self._rooms.values():
            room.close()
        self._builder.close()
        if self.directory is not None:
            self.directory.close()

    def _newest(self) -> RoomList:
        return RoomList(rooms=(), slots=()) if self.follower is None else self.follower.newest

    def _found(self, found: RoomList) -> dict[str, Room]:
        if not found.rooms:
            raise DeltalightError(
                "the directory of rooms has none; start it with a rooms file that names some."
            )
        names = tuple(status.name for status in found.rooms)
        return {status.name: self._builder.of_directory(status, names) for status in found.rooms}

    def _follow(self, name: str, endpoints: RoomEndpoints | None) -> None:
        if name in self._rooms:
            self._rooms[name].follow(endpoints)

    def _announce(self) -> None:
        next(iter(self._rooms.values())).context.events.publish("rooms", {})


class _Builder:
    """Builds rooms, with what they share."""

    def __init__(self, settings: ApiSettings, store: Store, keys: Keys | None, metrics: RoomMetrics) -> None:
        self._settings, self._store, self._keys, self._metrics = settings, store, keys, metrics
        self._problems, self._cameras = Problems(), CameraFinder()
        self._tickets = Tickets(store=store.tickets)
        self._recordings = RecordingStore(store.recordings)
        self._videos = RecordingVideos(self._recordings)
        self._snapshots = SnapshotStore(store.folder / "snapshots")
        self._pools = make_pools()
        self._streams = StreamLimits()
        self._whep = WhepSessions(settings, store.tokens, self._streams)

    def close(self) -> None:
        """Ends what the rooms share."""
        self._videos.close()

    def single(self) -> Room:
        """Returns the room of an installation that has one."""
        settings = self._settings
        context = self._context(
            ONLY_ROOM,
            self._store,
            settings.control,
            settings.subscribe,
            settings.control,
            playback=settings.playback,
        )
        return self._room(context, settings.subscribe)

    def of_directory(self, status: RoomStatus, rooms: Sequence[str]) -> Room:
        """Returns a room of a directory, which is followed later; one without a scene gets an empty one."""
        assert self._settings.rooms is not None
        store = self._store.of_room(status.name, rooms)
        if store.scenes.active_id() is None:
            activate_first(store, SceneDocument(name=status.title))
        nodes = tuple(node.endpoint for node in status.nodes)
        context = self._context(status.name, store, None, nodes, self._settings.rooms)
        return self._room(context, nodes, nodes)

    def _room(self, context: Context, endpoints: Sequence[str], nodes: tuple[str, ...] = ()) -> Room:
        streams = Streams(endpoints, _sinks(context, self._metrics), self._keys)
        context.link.on_source = streams.use_source
        return Room(context, streams, self._metrics, nodes)

    def _context(
        self,
        room: str,
        store: Store,
        control: str | None,
        endpoints: Sequence[str],
        server: str,
        *,
        playback: str | None = None,
    ) -> Context:
        """Builds the context of a room; `server` and `playback` are as for `ReplayControl`."""
        events, watch = EventHub(), ProcessWatch()
        link = RenderLink(
            store,
            control,
            self._keys,
            on_delivery=lambda status: events.publish("picture", asdict(status)),
            chooses_source=self._settings.jobs,
        )
        live_hub = LiveHub(link.watch, on_failure=lambda reason: events.publish("notice", {"text": reason}))
        replay = self._replay(link, events, server, playback)
        return Context(
            store=store,
            link=link,
            events=events,
            live=live_hub,
            fisheye=FisheyeView(),
            watch=watch,
            cameras=self._cameras,
            tickets=self._tickets,
            recordings=self._recordings,
            videos=self._videos,
            recording_sessions=self._recording_sessions(room, endpoints, events),
            replay=replay,
            snapshots=self._snapshots,
            settings=self._settings,
            problems=self._problems,
            metrics=Metrics(self._problems, watch, link, live_hub, events),
            pools=self._pools,
            streams=self._streams,
            whep=self._whep,
            room=room,
            server_name=RENDER_SERVER if control is not None else room,
        )

    def _replay(self, link: RenderLink, events: EventHub, server: str, playback: str | None) -> ReplayControl:
        def publish(position: Position | None) -> None:
            events.publish("replay", recordings.replay_answer(position).model_dump())

        def notice(text: str) -> None:
            events.publish("notice", {"text": text})

        return ReplayControl(link, server, publish, notice, keys=self._keys, playback=playback)

    def _recording_sessions(self, room: str, endpoints: Sequence[str], events: EventHub) -> RecordingSessions:
        def publish(session: RecordingSession, is_growing: bool) -> None:
            body = recordings.recording_event(self._recordings, session, is_growing=is_growing)
            events.publish("recording", body)

        return RecordingSessions(
            self._recordings,
            endpoints,
            publish,
            lambda text: events.publish("notice", {"text": text}),
            None if self._settings.rooms is None else (self._settings.rooms, room),
        )


def _sinks(context: Context, metrics: RoomMetrics) -> dict[str, Sink]:
    """Routes composites to viewers, radiance to the fish-eye view, reports to the watch and to event listeners."""
    return {
        "composite": lambda message, parts: _publish_composite(context, metrics, message, parts),
        "cameras": lambda message, _parts: _publish_cameras(context, message),
        "radiance": context.fisheye.note,
        "stats": lambda message, _parts: _publish_report(context, message),
    }


def _publish_composite(
    context: Context, metrics: RoomMetrics, message: Message, parts: Sequence[memoryview]
) -> None:
    if isinstance(message, CompositeMessage) and message.encoding == "jpeg":
        metrics.note_frame(context.room, (message.rendered_ns - message.received_ns) / 1e9)
        renderer = context.watch.detail(context.live.server_of(message))
        context.live.publish(message, [bytes(part) for part in parts], renderer)


def _publish_cameras(context: Context, message: Message) -> None:
    if isinstance(message, CamerasMessage) and context.live.note_cameras(message):
        cameras = [{"name": each.node, "status": each.status} for each in message.cameras]
        context.events.publish("cameras", {"cameras": cameras})


def _publish_report(context: Context, message: Message) -> None:
    if isinstance(message, StatsMessage):
        report = context.watch.note(message)
        context.events.publish("process", ProcessAnswer.of(report).model_dump())
