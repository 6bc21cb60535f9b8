"""The real room over REST."""

from pathlib import Path

from tests.services.api_samples import running_api, sentence
from tests.services.render_server_samples import Recorder
from tests.services.test_api_scenes import wait_for


def test_the_room_is_the_render_servers_file_and_nothing_stays(tmp_path: Path) -> None:
    with running_api(tmp_path) as api:
        before = set(api.store.folder.iterdir())
        server = Recorder(api.control_port)
        try:
            wait_for(lambda: api.client.get("/state").json()["render_server"] == "answers")
            answer = api.client.get("/live/room.glb")
            assert (answer.status_code, answer.content) == (200, b"glTF")
            assert answer.headers["content-type"] == "model/gltf-binary"
            assert answer.headers["cache-control"] == "no-store"
            server.fault = "no shared folder"
            assert "run it on this host" in sentence(api.client.get("/live/room.glb"), 502)
        finally:
            server.close()
        assert set(api.store.folder.iterdir()) <= before
