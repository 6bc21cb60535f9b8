"""Requests that schemathesis makes of the OpenAPI description: no 5xx, and answers keep to what is described."""

from collections.abc import Iterator

import pytest
import schemathesis
from schemathesis import Case, Config
from schemathesis.checks import not_a_server_error
from schemathesis.specs.openapi import checks
from schemathesis.specs.openapi.schemas import OpenApiSchema

from services import ports
from tests.services.api_samples import RunningApi, running_api
from tests.services.render_server_samples import Recorder
from tests.services.storage_samples import TETRAHEDRON, upload

CHECKS = [
    not_a_server_error,
    checks.status_code_conformance,
    checks.content_type_conformance,
    checks.response_headers_conformance,
    checks.response_schema_conformance,
    checks.negative_data_rejection,
]
CONFIG = Config.from_dict(
    {"generation": {"max-examples": 10, "deterministic": True, "database": "none"}, "seed": 1}
)


@pytest.fixture(scope="module")
def api(tmp_path_factory: pytest.TempPathFactory) -> Iterator[RunningApi]:
    (control_port,) = ports.private_ports(1)
    server = Recorder(control_port)
    with running_api(
        tmp_path_factory.mktemp("data"), control=ports.endpoint(control_port), requests_per_s=10_000
    ) as running:
        upload(running.store, TETRAHEDRON, "t.obj")
        yield running
    server.close()


@pytest.fixture(scope="module")
def described(api: RunningApi) -> OpenApiSchema:
    CONFIG.projects.default.base_url = str(api.client.base_url.copy_with(path="/"))
    return schemathesis.openapi.from_dict(api.app.openapi(), config=CONFIG)


schema = schemathesis.pytest.from_fixture("described")


@schema.parametrize()
def test_answers_keep_to_the_description(case: Case) -> None:
    case.call_and_validate(checks=CHECKS)
