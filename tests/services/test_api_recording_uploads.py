"""Uploads of recordings: .mcap files and zipped dataset folders, what they lack, and hostile ones."""

import io
import stat
import zipfile
from collections.abc import Iterator
from pathlib import Path

import httpx
import pytest

from deltalight.protocol.recording_reader import RecordingReader
from deltalight.services.client import Client
from deltalight.services.recording_copies import export_recording
from tests.protocol.fisheye_samples import assert_same_frames
from tests.services.api_samples import RunningApi, running_api, sentence
from tests.services.record_samples import frames, write

LIMIT_MB = 2
BINARY = {"Content-Type": "application/octet-stream"}


@pytest.fixture(scope="module")
def api(tmp_path_factory: pytest.TempPathFactory) -> Iterator[RunningApi]:
    with running_api(tmp_path_factory.mktemp("data"), recording_limit_mb=LIMIT_MB) as running:
        yield running


@pytest.fixture(scope="module")
def take(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write(tmp_path_factory.mktemp("take") / "desk.mcap", frames(3, with_fisheye=True))


@pytest.fixture(scope="module")
def folder(take: Path) -> Path:
    return export_recording(take, take.with_name("folder"), lambda numbers: numbers).out


def send(api: RunningApi, content: bytes, name: str) -> httpx.Response:
    return api.client.post("/recordings/upload", params={"name": name}, content=content, headers=BINARY)


def packed(folder: Path, *more: tuple[str, bytes], root: str = "desk/", without: str = "") -> bytes:
    data = io.BytesIO()
    with zipfile.ZipFile(data, "w") as archive:
        for path in sorted(folder.rglob("*")):
            if path.is_file() and path.name != without:
                archive.write(path, root + path.relative_to(folder).as_posix())
        for name, content in more:
            archive.writestr(name, content)
    return data.getvalue()


def nothing_is_left(api: RunningApi) -> bool:
    return not any((api.store.folder / "recordings" / ".incoming").iterdir())


def test_a_recording_is_kept_as_it_is_with_a_checklist(api: RunningApi, take: Path) -> None:
    with Client(str(api.client.base_url).removesuffix("/api/v1/")) as client:
        kept = client.upload_recording(take)
    assert (kept["id"], kept["state"], kept["frames"]) == ("desk", "finished", 3)
    assert [(check["what"], check["is_there"]) for check in kept["checklist"]] == [
        ("depth", True),
        ("pose", True),
        ("light", True),
    ]
    assert api.client.get("/recordings/desk/content").content == take.read_bytes()
    again = send(api, take.read_bytes(), "../desk.mcap").json()
    assert again["id"] == "desk-2", "another name where one is taken"
    assert nothing_is_left(api)


def test_a_zipped_folder_becomes_the_recording_that_it_was_made_of(
    api: RunningApi, take: Path, folder: Path, tmp_path: Path
) -> None:
    answer = send(api, packed(folder, ("__MACOSX/x", b""), ("desk/scene.json", b"{}")), "my desk!.zip")
    assert (answer.status_code, answer.json()["id"]) == (201, "my-desk")
    (tmp_path / "a.mcap").write_bytes(api.client.get("/recordings/my-desk/content").content)
    for one, other in zip(RecordingReader(take), RecordingReader(tmp_path / "a.mcap"), strict=True):
        assert_same_frames(one, other)
    bare = send(api, packed(folder, root="", without="depth.txt"), "bare.zip").json()
    assert not bare["checklist"][0]["is_there"]
    assert "model of the room" in bare["checklist"][0]["text"]


def link(name: str) -> bytes:
    data, info = io.BytesIO(), zipfile.ZipInfo(name)
    info.external_attr = (stat.S_IFLNK | 0o777) << 16
    with zipfile.ZipFile(data, "w") as archive:
        archive.writestr(info, "/etc/passwd")
    return data.getvalue()


def bomb() -> bytes:
    data = io.BytesIO()
    with zipfile.ZipFile(data, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("rgb.txt", bytes((LIMIT_MB + 1) << 20))
    return data.getvalue()


@pytest.mark.parametrize(
    ("content", "told"),
    [
        (b"no recording at all", "neither an .mcap recording nor a .zip"),
        (b"\x89MCAP0\r\n" + bytes(100), "hostile.mcap"),
        (bomb(), "more than 2 MB unpacked"),
        (link("rgb.txt"), "holds the link"),
    ],
    ids=["text", "mcap", "bomb", "link"],
)
def test_what_is_no_recording_is_refused_in_a_sentence(api: RunningApi, content: bytes, told: str) -> None:
    refused = sentence(send(api, content, "hostile.mcap"), 422)
    assert told in refused
    assert str(api.store.folder) not in refused, "clients know no paths"
    assert nothing_is_left(api)


def test_hostile_folders_are_refused_in_a_sentence(api: RunningApi, folder: Path) -> None:
    def told(*more: tuple[str, bytes], without: str = "") -> str:
        refused = sentence(send(api, packed(folder, *more, without=without), "hostile.zip"), 422)
        assert str(api.store.folder) not in refused
        return refused

    assert "outside its own folder" in told(("../escape.txt", b""))
    assert "outside its own folder" in told(("/etc/x", b""))
    assert "2 folders with rgb.txt" in told(("other/rgb.txt", b""))
    assert "0 folders with rgb.txt" in told(without="rgb.txt")
    assert "outside of the dataset folder" in told(
        ("desk/rgb.txt", b"1.0 ../../etc/passwd"), without="rgb.txt"
    )
    assert "outside of the dataset folder" in told(
        ("desk/depth.txt", b"1.0 /etc/passwd"), without="depth.txt"
    )
    assert "which is missing" in told(("desk/rgb.txt", b"1.0 gone.png"), without="rgb.txt")
    assert nothing_is_left(api)


def test_uploads_have_limits_of_size_and_room(api: RunningApi, take: Path, tmp_path: Path) -> None:
    assert "larger than 2 MB" in sentence(send(api, bytes((LIMIT_MB << 20) + 1), "big.mcap"), 413)
    with running_api(tmp_path, recording_quota_mb=1) as small:
        (tmp_path / "recordings" / "old.mcap").write_bytes(bytes(1 << 20))
        assert "delete some" in sentence(send(small, take.read_bytes(), "new.mcap"), 413)
    headers = {"Content-Type": "text/plain"}
    wrong = api.client.post("/recordings/upload", params={"name": "a"}, content=b"x", headers=headers)
    assert "application/octet-stream" in sentence(wrong, 415)
