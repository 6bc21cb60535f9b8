"""What `deploy/` promises: files that their own tools accept, and commands that run as they stand there."""

import re
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import httpx
import pytest
import yaml
from prometheus_client.parser import text_string_to_metric_families

from deltalight.services import ports
from deltalight.services.api.settings import ApiSettings
from deltalight.services.rooms.rooms_file import load_rooms
from deltalight.services.settings import load_configuration
from tests.deploy.chart_samples import options_of
from tests.services.record_samples import slow_demo

ROOT = Path(__file__).parents[2]
DEPLOY = ROOT / "deploy"
COMPOSE = ROOT / "docker-compose.yml"
NVIDIA, DRI, OAK = (DEPLOY / f"docker-compose.{name}.yml" for name in ("nvidia", "dri", "oak"))
VIEW_TOKEN = "another-token-of-thirty-two-characters-or-more"
TOKEN = "a-token-of-at-least-thirty-two-characters"
VARIABLE = re.compile(r"\$\{[A-Z_]+:-([^}]*)\}")
METRIC = re.compile(r"\bdeltalight_\w+")


def compose_tool() -> list[str]:
    """`docker compose` where the plugin is there, else `docker-compose`."""
    plugin = ["docker", "compose"]
    if (
        shutil.which("docker")
        and subprocess.run([*plugin, "version"], capture_output=True, check=False).returncode == 0
    ):
        return plugin
    if shutil.which("docker-compose") is None:
        pytest.skip("neither `docker compose` nor docker-compose is installed")
    return ["docker-compose"]


def compose() -> dict[str, Any]:
    """docker-compose.yml with the defaults of its variables."""
    document: dict[str, Any] = yaml.safe_load(VARIABLE.sub(r"\1", COMPOSE.read_text()))
    return document


@pytest.mark.slow
@pytest.mark.parametrize(
    "files",
    [[COMPOSE], [COMPOSE, NVIDIA], [COMPOSE, DRI], [COMPOSE, OAK]],
    ids=["mesa", "nvidia", "dri", "oak"],
)
def test_compose_accepts_the_files(files: list[Path]) -> None:
    options = [part for file in files for part in ("--file", str(file))]
    for profile in ([], ["--profile", "monitoring"], ["--profile", "rooms"]):
        done = subprocess.run(
            [*compose_tool(), *options, *profile, "config"],
            cwd=ROOT,
            capture_output=True,
            text=True,
            check=False,
        )
        assert done.returncode == 0, done.stderr
    assert "graphics" in done.stdout or NVIDIA not in files


def test_the_dockerfile_passes_its_linter() -> None:
    done = subprocess.run(
        [Path(sys.executable).with_name("hadolint"), DEPLOY / "Dockerfile"],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr


def test_every_target_and_mounted_file_of_compose_is_there() -> None:
    targets = set(re.findall(r"^FROM \S+ AS (\S+)$", (DEPLOY / "Dockerfile").read_text(), re.MULTILINE))
    overrides = yaml.safe_load(NVIDIA.read_text())["services"]
    for service in (*compose()["services"].values(), *overrides.values()):
        assert service.get("build", {}).get("target", "node") in targets
        for mount in service.get("volumes", []):
            source = mount.split(":")[0]
            assert not source.startswith(".") or (ROOT / source).exists()


def test_volumes_belong_to_the_user_that_runs() -> None:
    """A new volume takes its owner from the folder that the image has at its place."""
    made = re.search(
        r"install --directory --owner=deltalight .*\\\n(.*)", (DEPLOY / "Dockerfile").read_text()
    )
    assert made is not None
    mounted = {
        mount.split(":")[1]
        for service in compose()["services"].values()
        if service.get("image", "").startswith("deltalight/")
        for mount in service["volumes"]
        if not mount.startswith((".", "/"))
    }
    assert mounted == set(made[1].split())


def test_health_is_checked_each_half_minute() -> None:
    ours = [
        each for each in compose()["services"].values() if each.get("image", "").startswith("deltalight/")
    ]
    assert len(ours) >= 3
    assert {each["healthcheck"]["interval"] for each in ours} == {"30s"}


@pytest.mark.parametrize(
    ("file", "service", "device", "rule"),
    [(OAK, "node", "/dev/bus/usb", ["c 189:* rmw"]), (DRI, "server", "/dev/dri", None)],
    ids=["oak", "dri"],
)
def test_containers_with_a_device_have_its_group(
    file: Path, service: str, device: str, rule: list[str] | None
) -> None:
    """As user 10001 they see it by the host's group alone."""
    override = yaml.safe_load(VARIABLE.sub(r"\1", file.read_text()))["services"][service]
    given = [*override.get("devices", []), *override.get("volumes", [])]
    assert [each.split(":")[0] for each in given] == [device]
    assert override.get("device_cgroup_rules") == rule
    assert [group.isdecimal() for group in override["group_add"]] == [True]


@pytest.mark.parametrize("file", [NVIDIA, DRI], ids=["nvidia", "dri"])
@pytest.mark.parametrize("service", ["server", "rooms"])
def test_the_commands_on_gpus_are_the_other_one_without_software(file: Path, service: str) -> None:
    override = yaml.safe_load(file.read_text())["services"][service]["command"]
    ours = [word for word in compose()["services"][service]["command"] if word != "--allow-software"]
    assert override == ours


def test_the_service_of_rooms_has_known_options_settings_and_rooms(monkeypatch: pytest.MonkeyPatch) -> None:
    service = compose()["services"]["rooms"]
    command, *options = service["command"]
    assert {option.partition("=")[0] for option in options} <= options_of(command)
    assert f"--rooms={service['volumes'][2].split(':')[1]}" in options
    rooms = load_rooms(ROOT / service["volumes"][2].split(":")[0])
    assert len(rooms.rooms) == len(rooms.devices) == 2
    assert rooms.nodes["desk"].source == "/recordings/demo.mcap"
    for name, value in service["environment"].items():
        monkeypatch.setenv(name, value)
    settings = load_configuration().section("api", ApiSettings)
    secrets = {f"/run/secrets/{name}" for name in service["secrets"]}
    assert {str(settings.token_file), str(settings.view_token_file)} == secrets
    assert settings.leaves_host


def test_prometheus_asks_the_web_process_by_a_name_that_it_takes() -> None:
    """It takes addresses, as the service of rooms is asked by, and its container's own name."""
    jobs = yaml.safe_load((DEPLOY / "prometheus" / "prometheus.yml").read_text())["scrape_configs"]
    asked = [target for job in jobs for each in job.get("static_configs", ()) for target in each["targets"]]
    assert asked == [f"{compose()['services']['api']['hostname']}:8000"]
    assert all(each["type"] == "A" for job in jobs for each in job.get("dns_sd_configs", ()))


@contextmanager
def running(words: list[str]) -> Iterator[None]:
    child = subprocess.Popen([sys.executable, "-m", "deltalight.services.cli", *words], cwd=ROOT)
    try:
        yield
    finally:
        child.terminate()
        try:
            child.wait(15)
        except subprocess.TimeoutExpired:
            child.kill()
            child.wait()


def healthy(words: list[str]) -> bool:
    return subprocess.run([sys.executable, "-m", *words], cwd=ROOT, check=False).returncode == 0


@pytest.mark.slow
def test_the_commands_of_compose_run_and_their_health_checks_pass(tmp_path: Path) -> None:
    """With the same sockets, secret and checks; only the places of files and the port are others."""
    (port,) = ports.private_ports(1)
    for folder in ("run", "data"):
        (tmp_path / folder).mkdir()
    secret = tmp_path / "control_token"
    secret.write_text(TOKEN + "\n")
    seeing = tmp_path / "view_token"
    seeing.write_text(VIEW_TOKEN + "\n")
    places = {
        "/run/deltalight": str(tmp_path / "run"),
        "/var/lib/deltalight": str(tmp_path / "data"),
        "/recordings": str(slow_demo(tmp_path).parent),
        "/run/secrets/control_token": str(secret),
        "/run/secrets/view_token": str(seeing),
        "127.0.0.1:8000": f"127.0.0.1:{port}",
    }

    def here(words: list[str]) -> list[str]:
        for inside, outside in places.items():
            words = [word.replace(inside, outside) for word in words]
        return words

    services = {name: compose()["services"][name] for name in ("node", "server", "api")}
    with ExitStack() as stack:
        for name, service in services.items():
            own = ["--port", str(port)] if name == "api" else []
            stack.enter_context(running([*here(service["command"]), *own]))
        for name, service in services.items():
            check = here(service["healthcheck"]["test"])
            assert check[:3] == ["CMD", "python", "-m"]
            deadline = time.monotonic() + 120
            while not healthy(check[3:]):
                assert time.monotonic() < deadline, f"{name} did not become healthy"
        client = httpx.Client(base_url=f"http://127.0.0.1:{port}/api/v1", timeout=30)
        assert client.get("/state").status_code == 401
        client.headers["Authorization"] = f"Bearer {TOKEN}"
        assert client.get("/state").json()["render_server"] == "answers"
        scenes = client.get("/scenes").json()
        assert [scene["active"] for scene in scenes] == [True], "the first start shows a scene"
        client.headers["Authorization"] = f"Bearer {VIEW_TOKEN}"
        assert client.post("/scenes", json={}).status_code == 403, "a monitor changes nothing"
        check_metrics(client.get("/metrics").text)


def check_metrics(text: str) -> None:
    """Boards and alerts ask for names that the service gives."""
    check_names(
        text, [DEPLOY / "prometheus" / "alerts.yml", DEPLOY / "grafana" / "boards" / "deltalight.json"]
    )


def check_names(text: str, files: Sequence[Path]) -> None:
    """Each metric that the files ask for is in this text of a service."""
    given = {sample.name for family in text_string_to_metric_families(text) for sample in family.samples}
    families = {family.name for family in text_string_to_metric_families(text)}
    asked = {name for file in files for name in METRIC.findall(file.read_text())}
    missing = {name for name in asked if name not in given and name.removesuffix("_total") not in families}
    assert not missing


@pytest.mark.skipif(shutil.which("systemd-analyze") is None, reason="systemd-analyze is not installed")
def test_systemd_understands_the_unit(tmp_path: Path) -> None:
    text = (DEPLOY / "systemd" / "deltalight-node.service").read_text()
    program = tmp_path / "deltalight"
    program.write_text("#!/bin/sh\n")
    program.chmod(0o755)
    unit = tmp_path / "deltalight-node.service"
    unit.write_text(text.replace("/opt/deltalight/.venv/bin/deltalight", str(program)))
    done = subprocess.run(
        ["systemd-analyze", "verify", "--man=no", unit], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert str(unit.name) not in done.stderr, done.stderr
