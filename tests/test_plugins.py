"""The examples of docs/plugins.md, installed as packages: they work, and broken ones leave the others alone."""

import json
import os
import re
import subprocess
import sys
import tomllib
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
import structlog

from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.methods import InstalledMethod, load_methods
from deltalight.protocol.plugins import LoadedPlugins
from deltalight.protocol.scene_method import BUILT_IN_METHODS, DvctMethod, NoneMethod
from deltalight.protocol.scene_objects import SceneObject
from deltalight.render_server.graph import Graph
from deltalight.render_server.methods import registry
from deltalight.render_server.methods.method import SOFTWARE_DEFAULTS, RelightingMethod
from deltalight.render_server.methods.surface_shading import Layers
from deltalight.sensor_node.cameras.discovery import discover
from deltalight.sensor_node.cameras.drivers import driver_plugins
from deltalight.sensor_node.cameras.open import is_live, open_camera
from deltalight.sensor_node.cameras.settings import CameraSettings
from deltalight.services import doctor
from deltalight.services.cli import run

ROOT = Path(__file__).resolve().parents[1]
PAGE = (ROOT / "docs" / "plugins.md").read_text(encoding="utf-8")
MODULES = dict(re.findall(r"```python\n# (\w+)\.py\n(.*?)```", PAGE, re.DOTALL))
PROJECTS = [tomllib.loads(text)["project"] for text in re.findall(r"```toml\n(.*?)```", PAGE, re.DOTALL)]
Groups = dict[str, dict[str, str]]
Install = Callable[[str, str, Groups, dict[str, str]], None]


def install_package(folder: Path, name: str, version: str, groups: Groups, modules: dict[str, str]) -> None:
    """What pip leaves in a folder of packages."""
    info = folder / f"{name.replace('-', '_')}-{version}.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: {version}\n")
    lines = [
        f"[{group}]\n" + "".join(f"{key} = {value}\n" for key, value in points.items())
        for group, points in groups.items()
    ]
    (info / "entry_points.txt").write_text("\n".join(lines))
    for module, text in modules.items():
        (folder / f"{module}.py").write_text(text)


def install_examples(folder: Path) -> None:
    for project in PROJECTS:
        install_package(folder, project["name"], project["version"], project["entry-points"], MODULES)


@pytest.fixture
def install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Install]:
    """Installs packages for this test; those of the page are there already."""
    install_examples(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    known = set(sys.modules)
    yield lambda *package: install_package(tmp_path, *package)
    structlog.reset_defaults()  # a command sent log lines to a stderr that pytest closes
    for name in set(sys.modules) - known:
        if str(tmp_path) in str(getattr(sys.modules[name], "__file__", "")):
            del sys.modules[name]


def test_the_page_has_a_module_and_a_project_for_each_group() -> None:
    assert set(MODULES) == {"direct_light", "bars_camera"}
    assert [list(project["entry-points"]) for project in PROJECTS] == [
        ["deltalight.methods"],
        ["deltalight.cameras"],
    ]
    assert all(text.count("\n") <= 70 for text in MODULES.values())


# The scene document's models are made when they are imported, so a new method needs a new process.
SCRIPT = """
import json, sys
from pathlib import Path
from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.scene import parse_scene, scene_json_schema

def fault(method):
    try:
        parse_scene({"method": method})
    except DeltalightError as error:
        return str(error)

told = {
    "faults": [fault(method) for method in ({"name": "dirct"}, {"name": "direct", "ambiant": 1},
                                            {"name": "direct", "ambient": -1}, {"name": "fog"})],
    "schema": scene_json_schema()["$defs"].get("DirectMethod"),
    "opengl": "moderngl" in sys.modules,
}

import numpy as np
import trimesh
from deltalight.protocol.camera_model import CameraModel
from deltalight.protocol.frames import BoardPose, ViewFrame
from deltalight.render_server.gpu.context import create_context
from deltalight.render_server.renderer import SceneRenderer

folder = Path(sys.argv[1])
for name, extents, height in (("floor", (4, 4, 0.02), -0.01), ("cube", (0.2, 0.2, 0.2), 0.1)):
    mesh = trimesh.creation.box(extents)
    mesh.apply_translation((0, 0, height))
    mesh.export(folder / f"{name}.ply")
document = parse_scene({
    "real": {"geometry": {"model": str(folder / "floor.ply")}},
    "objects": [{"asset": str(folder / "cube.ply"), "material": {"base_color": [0.5, 0.5, 0.5], "specular": 0}}],
    "lights": {"manual": [{"type": "directional", "direction": [1, 0, -1], "irradiance": 2},
                          {"type": "ambient", "radiance": 0.2}], "surroundings": "none"},
})
pose = np.diag([1.0, -1.0, -1.0, 1.0])  # from above, the picture's right is +x
pose[2, 3] = 1.5
camera = CameraModel(128, 96, np.array([[100.0, 0, 63.5], [0, 100.0, 47.5], [0, 0, 1]]))
frame = ViewFrame(0, 0, np.full((96, 128, 3), 150, np.uint8), camera, pose=BoardPose(pose))
gpu = create_context()
pictures = {}
for name, method in (("none", {"name": "none"}), ("direct", {"name": "direct"}),
                     ("bright", {"name": "direct", "ambient": 4})):
    renderer = SceneRenderer(gpu, document.replaced(method=method))
    pictures[name] = renderer.render(frame).color
    renderer.release()
np.savez(folder / "pictures.npz", **pictures)

from deltalight.render_server.gpu.kernel import Kernel
from deltalight.render_server.gpu.textures import texture_2d

written = texture_2d(gpu, (2, 2), 4, "f4")
Kernel(gpu, Path(sys.argv[2]) / "fog").run(written.size, fog_out=written)
from deltalight.benchmarks.variants import RENDERED, parse_variants
from deltalight.protocol.method_names import require_method, with_method

(variant,) = parse_variants("direct:ambient=4", RENDERED)
chosen = variant.applied(document, 64), with_method(document, "direct")
told["chosen"] = [each.method.model_dump() for each in chosen]
for choose in (require_method, parse_variants):
    choose("direct")
    for name in ("fog", "dirct"):
        try:
            choose(name)
        except DeltalightError as error:
            told["faults"].append(str(error))
told["written"] = np.frombuffer(written.read(), np.float32).tolist()
print(json.dumps(told))
"""


FOG_SHADER = """
#include "common/basis.glsl"
layout(local_size_x = 2, local_size_y = 2) in;
layout(rgba32f) writeonly uniform image2D fog_out;
void main() { imageStore(fog_out, ivec2(gl_GlobalInvocationID.xy), vec4(basis_around(vec3(0, 0, 1))[2], 4.0)); }
"""


@pytest.fixture(scope="module")
def rendered(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """What a process with the example and a broken method says, and its pictures."""
    packages, folder = tmp_path_factory.mktemp("packages"), tmp_path_factory.mktemp("pictures")
    install_examples(packages)
    install_package(packages, "fog-method", "2.0", {"deltalight.methods": {"fog": "fog_method:method"}}, {})
    (packages / "fog.comp.glsl").write_text(FOG_SHADER)
    done = subprocess.run(
        [sys.executable, "-c", SCRIPT, str(folder), str(packages)],
        cwd=ROOT,
        env={**os.environ, "PYTHONPATH": os.pathsep.join([str(packages), str(ROOT)])},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    with np.load(folder / "pictures.npz") as pictures:
        return {**json.loads(done.stdout), "pictures": dict(pictures)}


@pytest.mark.slow
def test_a_document_may_name_the_method_wherever_it_is_read(rendered: dict[str, Any]) -> None:
    misspelt, unknown_key, out_of_range, broken = rendered["faults"][:4]
    assert "the nearest is `direct`" in misspelt
    assert "`method.ambiant`; the nearest known key is `ambient`" in unknown_key
    assert "`method.ambient` is wrong" in out_of_range
    assert "plugin `fog` of package fog-method 2.0 (entry point fog_method:method" in broken
    assert "No module named 'fog_method'" in broken
    assert rendered["schema"]["required"] == ["name"]
    assert rendered["schema"]["properties"]["ambient"]["maximum"] == 10
    assert not rendered["opengl"]


@pytest.mark.slow
def test_commands_take_the_method_by_its_name(rendered: dict[str, Any]) -> None:
    adjusted, plain = rendered["chosen"]
    assert (adjusted["name"], adjusted["ambient"]) == ("direct", 4)
    assert (plain["name"], plain["ambient"]) == ("direct", 1)
    for broken, misspelt in (rendered["faults"][4:6], rendered["faults"][6:]):
        assert "plugin `fog` of package fog-method 2.0" in broken
        assert "the nearest is direct" in misspelt


@pytest.mark.slow
def test_a_plugin_has_kernels_of_its_own(rendered: dict[str, Any]) -> None:
    assert rendered["written"] == [0, 0, 1, 4] * 4


@pytest.mark.slow
def test_the_method_draws_shadows_of_lamps_and_even_light(rendered: dict[str, Any]) -> None:
    plain, direct, bright = (rendered["pictures"][name].astype(int) for name in ("none", "direct", "bright"))
    shadow = np.s_[46:50, 74:80]  # the lamp shines towards +x, so the shadow lies right of the cube
    assert (plain[shadow] == 150).all()
    assert (direct[shadow] < 130).all()
    assert (direct[:, :50] == 150).all()
    cube = np.s_[46:50, 61:66]
    assert (bright[cube] > direct[cube] + 10).all()
    assert (bright[shadow] > direct[shadow]).all()
    near = np.s_[46:50, 50:54]  # left of the cube: nothing but light that it reflects and blocks
    assert (direct[near] == 150).all()


def test_the_camera_is_listed_opened_and_read(
    install: Install, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    del install
    assert is_live("bars:4")
    with open_camera("bars:4", CameraSettings(width=64, height=48, fps=500)) as camera:
        first, second = camera.read(), camera.read()
    assert first.color.shape == (48, 64, 3)
    bars = ([100] * 4 + [200] * 4) * 9
    assert first.color[0, :, 0].tolist() == bars[first.frame_id % 8 :][:64]  # a pixel further in each frame
    assert first.depth is not None
    assert first.depth.depth_m.max() == 1.0
    assert second.frame_id > first.frame_id
    assert second.timestamp_ns > first.timestamp_ns
    assert run(["node", "--list", "--json"]) == 0
    listed = json.loads(capsys.readouterr().out)["cameras"]
    assert [each["name"] for each in listed if each["kind"] == "bars"] == ["Grey bars"]
    monkeypatch.setattr(doctor, "_renderers", lambda: iter(()))
    checks = {check.name: check for check in doctor.examine()}
    assert checks["camera bars:8"].state == "ok"


BROKEN = {
    "absent": ("nowhere:thing", {}, "No module named 'nowhere'"),
    "lacking": ("empty:thing", {"empty": ""}, "has no attribute 'thing'"),
    "failing": (
        "failing:thing",
        {"failing": "raise OSError('the licence\\nhas ended')"},
        "licence has ended",
    ),
    "another": ("another:thing", {"another": "thing = 3"}, "it names no"),
    "ending": ("ending:thing", {"ending": "raise SystemExit(3)"}, "SystemExit: 3"),
}


@pytest.mark.parametrize("name", BROKEN)
def test_a_broken_plugin_is_a_sentence_and_the_others_work(install: Install, name: str) -> None:
    value, modules, said = BROKEN[name]
    install("broken-thing", "0.1", {group: {name: value} for group in GROUPS}, modules)
    methods = load_methods()
    assert list(methods.values) == ["direct"]
    fault = methods.fault(name)
    assert fault is not None
    assert said in fault
    assert f"plugin `{name}` of package broken-thing 0.1 (entry point {value} in deltalight.methods)" in fault
    assert "\n" not in fault
    with pytest.raises(DeltalightError, match=r"package broken-thing 0\.1"):
        open_camera(f"{name}:0")
    found = discover()
    assert [camera.source for camera in found.cameras if camera.kind == "bars"] == ["bars:8"]
    (missing,) = (each for each in found.missing if each.kind == name)
    assert said in missing.details
    assert missing.hint == "fix or uninstall the package"


GROUPS = ("deltalight.methods", "deltalight.cameras")


def test_doctor_tells_of_methods(install: Install, monkeypatch: pytest.MonkeyPatch) -> None:
    install("fog-method", "2.0", {"deltalight.methods": {"fog": "fog_method:method"}}, {})
    monkeypatch.setattr("deltalight.protocol.methods.PLUGINS", load_methods())
    direct, fog = doctor._methods()
    assert (direct.name, direct.state, direct.detail) == (
        "method direct",
        "ok",
        "of package direct-light 1.0",
    )
    assert (fog.name, fog.state, fog.hint) == ("method fog", "note", "fix or uninstall the package")
    assert "No module named 'fog_method'" in fog.detail


def test_every_method_of_the_project_is_registered() -> None:
    relighting = {method.settings for method in registry.BUILT_IN}
    assert relighting == set(BUILT_IN_METHODS) - {NoneMethod}
    for settings in BUILT_IN_METHODS:
        choice = registry.choose_method(settings(), software=True)
        assert choice.relights_real is (settings is not NoneMethod)
        assert choice.plugin is None
    assert registry.choose_method(NoneMethod(), software=True).remark is None, "it has no setting for memory"


@pytest.mark.parametrize(
    ("name", "said"),
    [("dvct", "there is another one of that name"), ("indirect", "settings are called `direct`")],
)
def test_a_method_is_called_as_its_entry_point(install: Install, name: str, said: str) -> None:
    install("renamed", "1.0", {"deltalight.methods": {name: "direct_light:method"}}, {})
    methods = load_methods()
    assert list(methods.values) == ["direct"]
    assert [fault for fault in methods.faults.values() if said in fault and "package renamed 1.0" in fault]


@pytest.mark.parametrize("name", ["uvc", "synthetic"])
def test_a_plugin_takes_no_name_of_a_built_in_camera(install: Install, name: str) -> None:
    install("rival", "1.0", {"deltalight.cameras": {name: "bars_camera:driver"}}, {})
    (missing,) = (each for each in discover().missing if "package rival 1.0" in each.details)
    assert (missing.kind, "another one of that name" in missing.details) == (name, True)
    camera = open_camera(name, CameraSettings(width=64, height=48), calibrated=False)
    assert type(getattr(camera, "_inner", camera)).__name__ != "BarsCamera"


WEAK_DRIVER = """
from deltalight.sensor_node.cameras.driver import CameraDriver

def fail(*_):
    raise ValueError("no firmware")

unmade = CameraDriver("Unmade", fail, fail)
wrong = CameraDriver("Wrong", lambda request: request)
"""


def test_a_driver_that_fails_is_named(install: Install) -> None:
    points = {"unmade": "weak:unmade", "wrong": "weak:wrong"}
    install("weak-driver", "1.0", {"deltalight.cameras": points}, {"weak": WEAK_DRIVER})
    with pytest.raises(
        DeltalightError, match=r"`unmade` of package weak-driver 1\.0 .*ValueError: no firmware"
    ):
        open_camera("unmade")
    with pytest.raises(DeltalightError, match=r"`wrong` of package weak-driver 1\.0 .*makes no Camera"):
        open_camera("wrong:1")
    missing = {each.kind: each for each in discover().missing}
    assert "no firmware" in missing["unmade"].details
    assert "cannot search" in missing["wrong"].details
    assert "wrong:..." in missing["wrong"].hint


def test_drivers_are_named_without_being_loaded(install: Install) -> None:
    install(
        "slow-driver", "1.0", {"deltalight.cameras": {"slow": "slow_driver:driver"}}, {"slow_driver": "1 / 0"}
    )
    assert "slow" in [plugin.name for plugin in driver_plugins()]
    assert is_live("slow:0")
    assert not is_live("bar:0")
    assert "slow_driver" not in sys.modules


def test_a_method_that_cannot_declare_its_stages_is_named(
    install: Install, monkeypatch: pytest.MonkeyPatch
) -> None:
    del install
    (direct,) = load_methods().values.values()

    def declare(*_: object) -> Any:  # noqa: ANN401
        raise ImportError("no module of mine")

    broken = InstalledMethod(direct.plugin, direct.settings, RelightingMethod(direct.settings, declare))
    monkeypatch.setattr(registry, "PLUGINS", LoadedPlugins({"direct": broken}, {}))
    choice = registry.choose_method(direct.settings(), software=True)
    assert choice.resolved == SOFTWARE_DEFAULTS
    nothing = cast(Any, None)
    with pytest.raises(DeltalightError, match=r"`direct` of package direct-light 1\.0 .*no module of mine"):
        choice.declare(Graph(nothing), nothing, nothing)
    silent = RelightingMethod(direct.settings, lambda *_: cast(Any, None))
    forgetful = InstalledMethod(direct.plugin, direct.settings, silent)
    monkeypatch.setattr(registry, "PLUGINS", LoadedPlugins({"direct": forgetful}, {}))
    choice = registry.choose_method(direct.settings(), software=True)
    with pytest.raises(DeltalightError, match=r"`direct` of package .* returns None, not Layers"):
        choice.declare(Graph(nothing), nothing, nothing)
    loose = RelightingMethod(direct.settings, lambda *_: Layers(*[cast(Any, 3)] * 9))
    monkeypatch.setattr(
        registry,
        "PLUGINS",
        LoadedPlugins({"direct": InstalledMethod(direct.plugin, direct.settings, loose)}, {}),
    )
    choice = registry.choose_method(direct.settings(), software=True)
    with pytest.raises(DeltalightError, match=r"`direct` of package .* its Layers is `int`, not a Resource"):
        choice.declare(Graph(nothing), nothing, nothing)
    light = InstalledMethod(direct.plugin, direct.settings, DvctMethod)
    monkeypatch.setattr(registry, "PLUGINS", LoadedPlugins({"direct": light}, {}))
    with pytest.raises(DeltalightError, match="it names no RelightingMethod"):
        registry.choose_method(direct.settings(), software=True)


def layers_of(made: Any) -> Layers:  # noqa: ANN401
    """One resource in the place of each that a method must declare."""
    return Layers(made, made, made, made, made, made, made, made, made)


def test_a_stage_that_fails_is_named_with_its_plugin(
    install: Install, monkeypatch: pytest.MonkeyPatch
) -> None:
    del install
    (direct,) = load_methods().values.values()

    def fail() -> None:
        raise ValueError("too thin")

    def declare(graph: Graph, *_: object) -> Any:  # noqa: ANN401
        return layers_of(graph.stage("fog", fail))

    weak = InstalledMethod(direct.plugin, direct.settings, RelightingMethod(direct.settings, declare))
    monkeypatch.setattr(registry, "PLUGINS", LoadedPlugins({"direct": weak}, {}))
    choice = registry.choose_method(direct.settings(), software=True)
    nothing = cast(Any, None)
    graph = Graph(nothing)
    choice.declare(graph, nothing, nothing)
    with pytest.raises(
        DeltalightError,
        match=r"`direct` of package direct-light 1\.0 .*\(stage `fog`, ValueError: too thin\)",
    ):
        graph.run()
    own = Graph(nothing)
    own.stage("fog", fail)
    with pytest.raises(ValueError, match="too thin"):
        own.run()


def test_what_a_plugin_does_with_objects_and_transparency_is_blamed_on_it(
    install: Install, monkeypatch: pytest.MonkeyPatch
) -> None:
    del install
    (direct,) = load_methods().values.values()

    def fail(*_: object) -> Any:  # noqa: ANN401
        raise KeyError("mesh")

    method = RelightingMethod(direct.settings, fail, require=fail)
    weak = InstalledMethod(direct.plugin, direct.settings, method)
    monkeypatch.setattr(registry, "PLUGINS", LoadedPlugins({"direct": weak}, {}))
    choice = registry.choose_method(direct.settings(), software=True)
    nothing = cast(Any, None)
    said = r"`direct` of package direct-light 1\.0 .*\(KeyError: 'mesh'\)"
    with pytest.raises(DeltalightError, match=said):
        choice.require([SceneObject(asset="cube.ply")])
    layers = replace(layers_of(nothing), transmit=fail)
    with pytest.raises(DeltalightError, match=said):
        choice.shaded(Graph(nothing), nothing, layers, (4, 4), nothing)


Stages = Callable[[Graph], Layers]


def wrong_value(graph: Graph) -> Layers:
    made: Any = graph.stage("fog", dict)
    return replace(layers_of(graph.source("other", "world")), lights=made)


def wrong_count(graph: Graph) -> Layers:
    return layers_of(graph.stages("fog", dict, outputs=("fog near", "fog far"))[0])


def unwritten_input(graph: Graph) -> Layers:
    return layers_of(graph.stage("fog", dict, "wind"))


@pytest.mark.parametrize(
    ("declared", "said"),
    [
        (wrong_value, "stage `fog`, TypeError: it returned `dict` for `fog`, which must be `LightBuffers`"),
        (wrong_count, "stage `fog`, GraphError: Stage `fog` returned 1 values for `fog near`, `fog far`"),
        (unwritten_input, "GraphError: Stage `fog` reads `wind`, which no stage writes"),
    ],
)
def test_a_stage_that_does_not_fit_is_named_with_its_plugin(
    install: Install, monkeypatch: pytest.MonkeyPatch, declared: Stages, said: str
) -> None:
    del install
    (direct,) = load_methods().values.values()
    method = RelightingMethod(direct.settings, lambda graph, *_: declared(graph))
    weak = InstalledMethod(direct.plugin, direct.settings, method)
    monkeypatch.setattr(registry, "PLUGINS", LoadedPlugins({"direct": weak}, {}))
    nothing = cast(Any, None)
    graph = Graph(nothing)
    registry.choose_method(direct.settings(), software=True).declare(graph, nothing, nothing)
    with pytest.raises(DeltalightError) as caught:
        graph.run()
    assert "`direct` of package direct-light 1.0" in str(caught.value)
    assert said in str(caught.value)
