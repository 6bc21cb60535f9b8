"""The Helm chart: rendered by Helm's own engine, accepted by Kubernetes' schemas, and true to what it starts."""

import re
import shlex
import subprocess
import sys
from functools import cache
from importlib.util import find_spec
from typing import Any

import pytest
import yaml

from deltalight import __version__
from deltalight.services import ports
from deltalight.services.rooms.ray_cluster import SLOT_RESOURCE
from deltalight.services.rooms.rooms_file import RoomsFile
from deltalight.services.settings import load_configuration
from tests.deploy.chart_samples import (
    CHART,
    EVERYTHING,
    ROOMS,
    SOFTWARE,
    Resource,
    of_kind,
    options_of,
    pods,
    rendered,
)
from tests.services.api_samples import running_api

KUBERNETES = "1.33"
CUSTOM = ("RayCluster", "ServiceMonitor")  # of operators: Kubernetes has no schema of them

pytestmark = pytest.mark.skipif(
    find_spec("helm_python") is None, reason="Helm's library has a wheel for Linux on x86-64 alone"
)


@pytest.fixture(scope="module", params=[{}, EVERYTHING, SOFTWARE], ids=["defaults", "everything", "software"])
def resources(request: pytest.FixtureRequest) -> list[Resource]:
    return rendered(request.param)


@pytest.fixture(scope="module")
def paths(tmp_path_factory: pytest.TempPathFactory) -> set[str]:
    """The routes of the OpenAPI document."""
    with running_api(tmp_path_factory.mktemp("data")) as api:
        return set(api.app.openapi()["paths"])  # type: ignore[attr-defined]


def containers(pod: Resource) -> list[Resource]:
    return [*pod["spec"]["initContainers"], *pod["spec"]["containers"]]


def all_containers(resources: list[Resource]) -> list[Resource]:
    return [each for pod in pods(resources).values() for each in containers(pod)]


def words(container: Resource) -> list[str]:
    """What a container runs, shell and all."""
    return shlex.split(" ".join([*container.get("command", []), *container.get("args", [])]))


def test_kubernetes_accepts_every_resource(resources: list[Resource]) -> None:
    import kubernetes_validate

    for each in resources:
        if each["kind"] not in CUSTOM:
            kubernetes_validate.validate(each, KUBERNETES, strict=True)
    for name, pod in pods(resources).items():
        template = {"apiVersion": "v1", "kind": "PodTemplate", "metadata": {"name": name}, "template": pod}
        kubernetes_validate.validate(template, KUBERNETES, strict=True)


def test_helm_finds_no_fault() -> None:
    import helm_python

    found = helm_python.lint(CHART, values={"rooms": ROOMS})
    assert found["errors"] == []
    assert [each["error"] for each in found["messages"]] == ["icon is recommended"]
    version = yaml.safe_load((CHART / "Chart.yaml").read_text())["appVersion"]
    assert version == __version__


@pytest.mark.parametrize(
    ("values", "where"),
    [
        ({}, "/rooms/nodes"),
        ({"rooms": ROOMS, "render": {"slots": 0}}, "/render/slots"),
        ({"rooms": ROOMS, "render": {"slot": 2}}, "'slot' not allowed"),
        ({"rooms": ROOMS, "existingSecret": ""}, "/existingSecret"),
        ({"rooms": ROOMS, "objectStore": {"assets": "/mnt/assets"}}, "/objectStore/assets"),
    ],
)
def test_wrong_values_are_refused(values: dict[str, Any], where: str) -> None:
    import helm_python

    with helm_python.Chart.load(CHART) as chart, pytest.raises(helm_python.HelmError, match=where):
        chart.validate_schema(chart.merge_values(values))


def test_no_container_may_more_than_it_needs(resources: list[Resource]) -> None:
    for pod in pods(resources).values():
        context = pod["spec"]["securityContext"]
        assert (context["runAsNonRoot"], context["runAsUser"]) == (True, 10001)
        assert context["seccompProfile"]["type"] == "RuntimeDefault"
        assert pod["spec"]["automountServiceAccountToken"] is False
    for container in all_containers(resources):
        context = container["securityContext"]
        assert (context["readOnlyRootFilesystem"], context["allowPrivilegeEscalation"]) == (True, False)
        assert context["capabilities"] == {"drop": ["ALL"]}
        assert {"cpu", "memory"} <= set(container["resources"]["requests"])
        assert "memory" in container["resources"]["limits"]


def test_secrets_come_from_secrets(resources: list[Resource]) -> None:
    assert of_kind(resources, "Secret") == []
    for container in all_containers(resources):
        for variable in container.get("env", []):
            if re.search("DATABASE|SECRET|PASSWORD|ACCESS_KEY|TOKEN$", variable["name"]):
                assert set(variable["valueFrom"]) == {"secretKeyRef"}
    text = yaml.safe_dump(resources)
    assert "postgresql://" not in text


def test_variables_are_settings(resources: list[Resource], monkeypatch: pytest.MonkeyPatch) -> None:
    """An unknown one would be refused, when the process starts."""
    from deltalight.protocol.keys import KeySettings
    from deltalight.services.api.settings import ApiSettings

    for container in all_containers(resources):
        with monkeypatch.context() as patch:
            for variable in container.get("env", []):
                patch.setenv(variable["name"], variable.get("value", "postgresql://u@h/d"))
            configuration = load_configuration()
            settings = configuration.section("api", ApiSettings)
            assert configuration.section("keys", KeySettings).name in ("fleet", None)
            assert container["name"] == "keys" or settings.leaves_host or container["name"] == "render"
            assert settings.jobs is (container["name"] != "web")


def test_web_processes_take_the_names_of_ingress_and_services(monkeypatch: pytest.MonkeyPatch) -> None:
    from deltalight.services.api.settings import ApiSettings

    mine = {
        "ingress": {"enabled": True, "host": "Station.example"},
        "web": {"allowedHosts": ["wall.example"]},
    }
    containers_of = {each["name"]: each for each in all_containers(rendered(mine))}
    for name in ("web", "keeper"):
        (hosts,) = (
            each["value"]
            for each in containers_of[name]["env"]
            if each["name"] == "DELTALIGHT_API__ALLOWED_HOSTS"
        )
        monkeypatch.setenv("DELTALIGHT_API__ALLOWED_HOSTS", hosts)
        taken = load_configuration().section("api", ApiSettings).allowed_hosts
        assert {"station.example", "wall.example", "fleet-web", "fleet-keeper.museum.svc"} <= set(taken)


def test_probes_ask_routes_that_are_there_at_ports_that_are_open(
    resources: list[Resource], paths: set[str]
) -> None:
    for pod in pods(resources).values():
        for container in pod["spec"]["containers"]:
            names = {port["name"] for port in container["ports"]}
            for kind in ("startupProbe", "livenessProbe", "readinessProbe"):
                (how, where) = next(
                    each for each in container[kind].items() if each[0] in ("httpGet", "tcpSocket")
                )
                assert where["port"] in names
                assert how == "tcpSocket" or where["path"] in paths
    for ingress in of_kind(resources, "Ingress"):
        for path in ingress["spec"]["rules"][0]["http"]["paths"]:
            route = re.sub("/rooms/[^/]+", "", path["path"])
            assert any(each.startswith(route) for each in paths)


def test_options_are_those_of_our_commands(resources: list[Resource]) -> None:
    checked = 0
    for container in all_containers(resources):
        if container["name"] not in ("web", "keeper"):
            continue
        given = words(container)
        if container["name"] == "keeper":
            given = " ".join(given).rpartition("exec deltalight ")[2].split()
        command, *options = given
        assert {option.partition("=")[0] for option in options} <= options_of(command)
        checked += 1
    assert checked == 2


@cache
def options_of_ray_start() -> set[str]:
    """Asked in a process of its own: Ray reads settings when it is imported, and other tests here need theirs."""
    listing = (
        "from ray.scripts.scripts import start; print(*(each for part in start.params for each in part.opts))"
    )
    return set(subprocess.check_output([sys.executable, "-c", listing], text=True).split())


@pytest.mark.skipif(find_spec("ray") is None, reason="Ray is not installed")
def test_ray_is_started_as_ray_takes_it(resources: list[Resource]) -> None:
    known = options_of_ray_start()
    for pod in (pods(resources)["keeper"], pods(resources)["render"]):
        (line,) = pod["spec"]["containers"][0]["args"]
        options = shlex.split(line.partition("ray start ")[2].partition(" && ")[0])
        assert {option.partition("=")[0] for option in options} <= known
        slots = next((each for each in options if each.startswith("--resources=")), None)
        assert slots is None or re.fullmatch(rf'--resources={{"{SLOT_RESOURCE}":\d+}}', slots), (
            "a whole number of slots"
        )


def test_ports_are_those_of_the_code(resources: list[Resource]) -> None:
    open_ports = {
        port["name"]: port["containerPort"]
        for pod in pods(resources).values()
        for port in pod["spec"]["containers"][0]["ports"]
    }
    assert (open_ports["page"], open_ports["directory"]) == (ports.PAGE_PORT, ports.ROOMS_PORT)
    text = " ".join(word for each in all_containers(resources) for word in words(each))
    assert set(re.findall(r"--port=(\d+)", text)) == {str(ports.PAGE_PORT), str(open_ports["gcs-server"])}
    assert set(re.findall(r"--rooms-port=(\d+)", text)) == {str(ports.ROOMS_PORT)}
    assert set(re.findall(r"-keeper:(\d+)", text)) == {
        str(ports.ROOMS_PORT),
        str(open_ports["gcs-server"]),
    }
    ranges = {
        (port["port"], port["endPort"])
        for policy in of_kind(resources, "NetworkPolicy")
        for rule in policy["spec"].get("ingress", [])
        for port in rule.get("ports", [])
        if "endPort" in port
    }
    ((low, high),) = ranges
    own = ports.PRIVATE_PORTS  # a process of the tests has every third of them or so
    assert low <= own[0] < low + own.step
    assert high - own.step < own[-1] <= high
    for service in of_kind(resources, "Service"):
        for port in service["spec"]["ports"]:
            assert port["port"] == open_ports[port["targetPort"]]


def selects(selector: Resource, pod: Resource) -> bool:
    return bool(selector["matchLabels"].items() <= pod["metadata"]["labels"].items())


def test_selectors_find_their_pods(resources: list[Resource]) -> None:
    found = pods(resources)

    def chosen(selector: Resource) -> set[str]:
        return {name for name, pod in found.items() if selects(selector, pod)}

    for each in (*of_kind(resources, "Service"), *of_kind(resources, "PodDisruptionBudget")):
        name = each["metadata"]["name"].removeprefix("fleet-")
        selector = each["spec"]["selector"]
        assert chosen(selector if "matchLabels" in selector else {"matchLabels": selector}) == {name}
    for policy in of_kind(resources, "NetworkPolicy"):
        assert chosen(policy["spec"]["podSelector"])
    for monitor in of_kind(resources, "ServiceMonitor"):
        labels = {"metadata": {"labels": monitor["spec"]["selector"]["matchLabels"]}}
        services = [
            each
            for each in of_kind(resources, "Service")
            if selects({"matchLabels": labels["metadata"]["labels"]}, each)
        ]
        assert [each["metadata"]["name"] for each in services] == ["fleet-keeper"]


def test_ray_and_render_servers_are_reached_by_this_release_alone(resources: list[Resource]) -> None:
    """Which component reaches which ports of which, by the policies; everything else is denied."""
    found = pods(resources)
    policies = of_kind(resources, "NetworkPolicy")
    denied = [each for each in policies if "ingress" not in each["spec"]]
    assert [name for name in found if selects(denied[0]["spec"]["podSelector"], found[name])] == list(found)
    allowed: set[tuple[str, str, str]] = set()
    for policy in policies:
        targets = [name for name in found if selects(policy["spec"]["podSelector"], found[name])]
        for rule in policy["spec"].get("ingress", []):
            where = [str(port["port"]) for port in rule.get("ports", [])] or ["all"]
            peers = rule.get("from", [{}])
            sources = {
                name
                for peer in peers
                for name in (found if "podSelector" in peer else ["anyone"])
                if name == "anyone" or selects(peer["podSelector"], found[name])
            }
            allowed |= {(source, target, port) for source in sources for target in targets for port in where}
    assert allowed == {
        ("anyone", "web", "page"),
        ("anyone", "keeper", "page"),
        ("render", "keeper", "all"),
        ("web", "keeper", "directory"),
        ("web", "keeper", "20000"),
        ("keeper", "render", "all"),
        ("render", "render", "all"),
        ("web", "render", "20000"),
    }


def test_volumes_that_are_mounted_are_there(resources: list[Resource]) -> None:
    for pod in pods(resources).values():
        volumes = {volume["name"] for volume in pod["spec"]["volumes"]}
        mounted = {mount["name"] for each in containers(pod) for mount in each["volumeMounts"]}
        assert mounted == volumes


def test_the_rooms_file_is_one(resources: list[Resource]) -> None:
    (rooms,) = of_kind(resources, "ConfigMap")
    assert RoomsFile.model_validate(yaml.safe_load(rooms["data"]["rooms.yaml"])).rooms


def test_gpus_are_asked_for_where_there_are_some() -> None:
    with_gpu = pods(rendered({}))["render"]["spec"]
    assert with_gpu["containers"][0]["resources"]["limits"]["nvidia.com/gpu"] == 1
    assert with_gpu["nodeSelector"] == {"nvidia.com/gpu.present": "true"}
    software = rendered(SOFTWARE)
    assert "nvidia" not in yaml.safe_dump(software)
    assert "--allow-software" in words(pods(software)["keeper"]["spec"]["containers"][0])
    assert not of_kind(software, "PersistentVolumeClaim")
    assert [each["metadata"]["name"] for each in of_kind(software, "PodDisruptionBudget")] == ["fleet-web"]
