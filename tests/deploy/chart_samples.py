"""The chart of deploy/helm as Helm's own engine renders it, for tests."""

from collections.abc import Mapping
from itertools import chain
from pathlib import Path
from typing import Any

import typer.main
import yaml

from deltalight.services.cli import app

CHART = Path(__file__).parents[2] / "deploy" / "helm" / "deltalight"
ROOMS = {
    "nodes": {"desk": {"source": "synthetic"}, "garden": {"endpoint": "tcp://fleet@10.0.0.7:5601"}},
    "rooms": {"hall": {"nodes": ["desk", "garden"], "labels": {"network": "hall"}}},
}
EVERYTHING = {
    "ingress": {"enabled": True},
    "serviceMonitor": {"enabled": True},
    "objectStore": {"assets": "s3://a/b", "endpoint": "https://store.example", "existingSecret": "s3"},
    "render": {"labels": {"network": "hall"}, "runtimeClassName": "nvidia"},
    "networkPolicy": {"webFrom": [{"namespaceSelector": {"matchLabels": {"name": "ingress"}}}]},
}
SOFTWARE = {"render": {"hosts": 1, "gpu": {"enabled": False}}, "data": {"existingClaim": "mine"}}
Resource = dict[str, Any]


def rendered(values: Mapping[str, Any]) -> list[Resource]:
    """The resources of a release called `fleet`."""
    import helm_python

    with helm_python.Chart.load(CHART) as chart:
        texts = chart.render({"rooms": ROOMS, **values}, name="fleet", namespace="museum")
    found = chain.from_iterable(yaml.safe_load_all(text) for text in texts.values())
    return [each for each in found if each is not None]


def of_kind(resources: list[Resource], kind: str) -> list[Resource]:
    return [each for each in resources if each["kind"] == kind]


def pods(resources: list[Resource]) -> dict[str, Resource]:
    """The pod templates by component."""
    (cluster,) = of_kind(resources, "RayCluster")
    (worker,) = cluster["spec"]["workerGroupSpecs"]
    found = [each["spec"]["template"] for each in of_kind(resources, "Deployment")]
    found += [cluster["spec"]["headGroupSpec"]["template"], worker["template"]]
    return {each["metadata"]["labels"]["app.kubernetes.io/component"]: each for each in found}


def options_of(command: str) -> set[str]:
    """The options of one of our commands."""
    group = typer.main.get_command(app)
    found = group.commands[command]  # type: ignore[attr-defined]
    return {option for parameter in found.params for option in parameter.opts}
