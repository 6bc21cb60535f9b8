"""The virtual camera: the kernel's numbers, and what is written to a device, which a file stands in for."""

import errno
import fcntl
import os
import shutil
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path

import cv2
import numpy as np
import pytest

from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.frames import SensorFrame
from deltalight.protocol.publisher import Publisher
from deltalight.services import ports
from deltalight.services import virtual_camera as module
from deltalight.services.commands import virtual_camera as command_module
from deltalight.services.commands.virtual_camera import virtual_camera
from deltalight.services.rooms.directory import DirectoryServer
from deltalight.services.rooms.keeper import RoomKeeper
from deltalight.services.virtual_camera import S_FMT, VirtualCamera, fitted, yuyv
from tests.services.conftest import ROOT, RunCli
from tests.services.record_samples import HEIGHT, WIDTH, composite, frames
from tests.services.room_samples import StandInPlacer, plans, running

OUTPUT, CAPTURE, DEVICE_CAPS = 2, 1, 0x80000000
CAPS_OFFSET, DEVICE_CAPS_OFFSET = 84, 88
HEADER = """
#include <linux/videodev2.h>
#include <stddef.h>
#include <stdio.h>
int main(void) {
  printf("%lu %lu %zu %zu ", (unsigned long)VIDIOC_QUERYCAP, (unsigned long)VIDIOC_S_FMT,
         sizeof(struct v4l2_capability), sizeof(struct v4l2_format));
  printf("%zu %zu ", sizeof(struct v4l2_pix_format), offsetof(struct v4l2_format, fmt));
  printf("%zu %zu ", offsetof(struct v4l2_capability, capabilities), offsetof(struct v4l2_capability, device_caps));
  printf("%u %u %u ", V4L2_CAP_VIDEO_OUTPUT, V4L2_CAP_DEVICE_CAPS, V4L2_PIX_FMT_YUYV);
  printf("%d %d %d %d %d", V4L2_BUF_TYPE_VIDEO_OUTPUT, V4L2_FIELD_NONE, V4L2_COLORSPACE_SRGB, V4L2_YCBCR_ENC_601,
         V4L2_QUANTIZATION_LIM_RANGE);
}
"""
# What HEADER prints on x86_64 with the header of Linux 6.1.
KERNEL = [0x80685600, 0xC0D05605, 104, 208, 48, 8, 84, 88, OUTPUT, DEVICE_CAPS, 0x56595559, 2, 1, 8, 1, 2]


class Kernel:
    """Answers ioctl as v4l2loopback does."""

    def __init__(self, able: int = OUTPUT | CAPTURE) -> None:
        self.able, self.fault = able, 0
        self.formats: list[tuple[int, ...]] = []
        self.shrinks = False

    def ioctl(self, _file: int, request: int, data: bytearray) -> int:
        if self.fault:
            raise OSError(self.fault, os.strerror(self.fault))
        if request != S_FMT:
            struct.pack_into("=I", data, CAPS_OFFSET, DEVICE_CAPS | OUTPUT)
            struct.pack_into("=I", data, DEVICE_CAPS_OFFSET, self.able)
            return 0
        self.formats.append(struct.unpack_from("=I4x12I", data))
        if self.shrinks:
            struct.pack_into("=I", data, 8, 16)
        return 0


@pytest.fixture
def kernel(monkeypatch: pytest.MonkeyPatch) -> Kernel:
    made = Kernel()
    monkeypatch.setattr(fcntl, "ioctl", made.ioctl)
    return made


@pytest.fixture
def device(tmp_path: Path) -> Path:
    path = tmp_path / "video10"
    path.touch()
    return path


def test_numbers_are_the_kernels(tmp_path: Path) -> None:
    ours = [
        *(module.QUERYCAP, S_FMT, module.CAPABILITY.size, module.FORMAT_BYTES, module.PIX_FORMAT.size),
        *(
            module.PIX_OFFSET,
            CAPS_OFFSET,
            DEVICE_CAPS_OFFSET,
            module.VIDEO_OUTPUT,
            module.DEVICE_CAPS,
            module.YUYV,
        ),
        *(module.BUF_TYPE_VIDEO_OUTPUT, module.FIELD_NONE),
        *(module.COLORSPACE_SRGB, module.YCBCR_601, module.LIMITED_RANGE),
    ]
    assert ours == KERNEL
    if shutil.which("cc") is None or not Path("/usr/include/linux/videodev2.h").exists():
        return
    (tmp_path / "a.c").write_text(HEADER)
    subprocess.run(["cc", "-o", tmp_path / "a", tmp_path / "a.c"], check=True)
    printed = subprocess.run([tmp_path / "a"], check=True, capture_output=True, text=True).stdout
    assert [int(word) for word in printed.split()] == KERNEL


def test_pictures_arrive_as_yuyv(kernel: Kernel, device: Path) -> None:
    rng = np.random.default_rng(1)
    picture = cv2.resize(rng.integers(0, 256, (4, 5, 3), np.uint8), (48, 32))
    with VirtualCamera(device) as camera:
        camera.begin((49, 33))
        camera.show(np.asarray(picture))
    assert kernel.formats == [(2, 48, 32, 0x56595559, 1, 96, 96 * 32, 8, 0, 0, 1, 2, 0)]
    data = np.frombuffer(device.read_bytes(), np.uint8).reshape(32, 48, 2)
    back = cv2.cvtColor(data, cv2.COLOR_YUV2RGB_YUYV)
    assert np.abs(back.astype(int) - picture).mean() < 4  # colour has half the columns


def test_black_is_16_and_shapes_are_kept() -> None:
    black = np.frombuffer(yuyv(np.zeros((2, 2, 3), np.uint8)), np.uint8)
    assert black.tolist() == [16, 128] * 4
    placed = fitted(np.full((10, 20, 3), 255, np.uint8), (40, 40))
    assert placed.shape == (40, 40, 3)
    assert placed[10:30].min() == 255
    assert placed[:10].max() == placed[30:].max() == 0


def test_what_is_no_virtual_camera_is_told(kernel: Kernel, device: Path, tmp_path: Path) -> None:
    with pytest.raises(DeltalightError, match=r"no .*none.*v4l2loopback.*sudo modprobe"):
        VirtualCamera(tmp_path / "none")
    kernel.able = CAPTURE
    with pytest.raises(DeltalightError, match="gives pictures and takes none"):
        VirtualCamera(device)
    kernel.able = OUTPUT
    with VirtualCamera(device) as camera:
        kernel.shrinks = True
        with pytest.raises(DeltalightError, match="refuses 48x32 pixels"):
            camera.begin((48, 32))
        kernel.fault = errno.EBUSY
        with pytest.raises(DeltalightError, match="Another program writes to"):
            camera.begin((48, 32))
    kernel.fault = errno.ENOTTY
    with pytest.raises(DeltalightError, match="is not a virtual camera"):
        VirtualCamera(device)


def test_the_command_without_a_device_is_one_sentence(cli: RunCli, tmp_path: Path) -> None:
    done = cli("virtual-camera", "--device", tmp_path / "video10")
    assert done.returncode == 2
    assert "virtual cameras need the kernel module v4l2loopback" in done.stderr
    assert len(done.stderr.splitlines()) == 1


@contextmanager
def publishing(frame: SensorFrame, endpoint: str = "tcp://127.0.0.1:*") -> Iterator[str]:
    """A render server that shows one picture; yields its endpoint."""
    publisher, stop = Publisher(endpoint), threading.Event()

    def publish() -> None:
        while not stop.wait(0.02):
            publisher.send(composite(frame))

    thread = threading.Thread(target=publish)
    thread.start()
    try:
        yield publisher.endpoint
    finally:
        stop.set()
        thread.join()
        publisher.close()


@pytest.mark.usefixtures("kernel")
def test_relit_pictures_are_shown_and_repeated(device: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (frame,) = frames(1)
    shown: list[np.ndarray] = []

    def show(_camera: VirtualCamera, picture: np.ndarray) -> None:
        shown.append(picture)
        if len(shown) == 3:
            raise KeyboardInterrupt

    monkeypatch.setattr(VirtualCamera, "show", show)
    monkeypatch.setattr(command_module, "PERIOD_S", 0.01)
    with publishing(frame) as endpoint, pytest.raises(KeyboardInterrupt):
        virtual_camera(device=device, composites=endpoint)
    assert [picture.shape for picture in shown] == [(HEIGHT, WIDTH, 3)] * 3
    assert all(np.array_equal(picture, frame.color) for picture in shown)


# The command with a kernel that takes every format; what is written to the device is appended to a file.
WITH_KERNEL = f"""
import fcntl, struct
def ioctl(_file, request, data):
    if request != {S_FMT}:
        struct.pack_into("=I", data, {CAPS_OFFSET}, {OUTPUT})
fcntl.ioctl = ioctl
from deltalight.services.cli import main
main()
"""


@pytest.mark.slow
def test_a_room_is_shown_whichever_render_server_it_has(device: Path, tmp_path: Path) -> None:
    before, after = frames(2)
    directory, placer = ports.endpoint(ports.private_ports(1)[0]), StandInPlacer()
    keeper = RoomKeeper(plans(tmp_path, "hall"), placer)
    running(keeper, placer, "hall")
    options = ["--device", str(device), "--rooms", directory, "--room", "hall"]
    command = [sys.executable, "-c", WITH_KERNEL, "virtual-camera", *options]

    def wait_for(frame: SensorFrame) -> None:
        """Waits until the last whole picture is this one."""
        wanted, deadline_s = yuyv(frame.color), time.monotonic() + 60
        while True:
            data = device.read_bytes()
            end = len(data) // len(wanted) * len(wanted)
            if data[max(0, end - len(wanted)) : end] == wanted:
                return
            assert time.monotonic() < deadline_s
            time.sleep(0.05)

    with closing(DirectoryServer(directory, keeper)):
        process = subprocess.Popen(command, cwd=ROOT)
        try:
            with publishing(before, placer.of("hall").publish):
                wait_for(before)
                placer.lose("hall")
                running(keeper, placer, "hall")
                with publishing(after, placer.of("hall").publish):
                    wait_for(after)  # although the earlier one still sends
            assert process.poll() is None
        finally:
            process.kill()
            process.wait()
