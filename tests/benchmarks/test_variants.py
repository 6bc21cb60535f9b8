"""What `--methods` and `--ablation` of the quality benchmark stand for."""

from itertools import pairwise

import pytest

from deltalight.benchmarks.cli import DEFAULT_METHODS
from deltalight.benchmarks.quality.ablation import ABLATION_STEPS, ablation_chain
from deltalight.benchmarks.variants import RENDERED, parse_variants
from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.scene import parse_scene
from deltalight.protocol.scene_method import DvctMethod, NoneMethod
from deltalight.render_server.methods.registry import choose_method

SCENE = parse_scene({"method": {"name": "dvct", "volume_edge_m": 0.7}})


def test_default_methods_are_known() -> None:
    assert [variant.name for variant in parse_variants(DEFAULT_METHODS)] == DEFAULT_METHODS.split(",")


def test_settings_belong_to_the_variant_before_them() -> None:
    first, second, third = parse_variants("exact:cone_count=32,cone_scale=1, paper,paper:shadow=map")
    assert first.settings == {"operator": "exact", "cone_count": 32, "cone_scale": 1}
    assert second.name == "paper"
    assert third.settings == {"operator": "paper", "shadow": "map"}


def test_variant_changes_its_settings_only() -> None:
    (variant,) = parse_variants("exact:cone_count=32")
    method = variant.applied(SCENE, 128).method
    assert method == DvctMethod(operator="exact", cone_count=32, volume_edge_m=0.7, volume_size=128)
    (own_size,) = parse_variants("exact:volume_size=64")
    own_method = own_size.applied(SCENE, 128).method
    assert isinstance(own_method, DvctMethod)
    assert own_method.volume_size == 64
    (hurried,) = parse_variants("exact:output.frame_budget_ms=125")
    assert hurried.applied(SCENE, None).output.frame_budget_ms == 125
    assert isinstance(parse_variants("none")[0].applied(SCENE, None).method, NoneMethod)


def test_the_floor_is_a_method_that_no_document_may_name() -> None:
    (raster,) = parse_variants("raster:quality=live", RENDERED)
    document = raster.applied(SCENE, 64)
    assert (document.method.method_name(), document.method.quality) == ("raster", "live")
    assert choose_method(document.method, software=True).resolved.triangle_budget < 40_000
    with pytest.raises(DeltalightError, match="raster"):
        parse_scene({"method": {"name": "raster"}})


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("guess", "exact"),
        ("", "exact"),
        ("camera:cone_count=3", "exact:KEY=VALUE"),
        ("exact:cone_cont=3", "cone_count"),
        ("exact:cone_count=1000", "64"),
        ("exact:cone_count=[", "YAML"),
        ("exact:output.frame_budget=9", "frame_budget_ms"),
        ("exact:lights.mode=fisheye", "output.KEY"),
        ("exact:cone_count", "KEY=VALUE"),
        ("exact,exact", "twice"),
        ("camera,path", "`path` .*add exact"),
        ("camera,path+oidn", r"`path\+oidn` .*add exact"),
        ("path,exact", "add exact to --methods before it"),
        ("raster:volume_size=64", "volume_size"),
    ],
)
def test_wrong_methods_are_refused_in_a_sentence(text: str, sentence: str) -> None:
    with pytest.raises(DeltalightError, match=sentence):
        parse_variants(text)


def test_ablation_goes_from_paper_to_exact_by_one_switch_a_row() -> None:
    chain = ablation_chain()
    assert len({variant.name for variant in chain}) == len(ABLATION_STEPS)
    assert chain[0].settings["operator"] == "paper"
    assert chain[-1].settings["operator"] == "exact"
    for before, after in pairwise(chain):
        assert before.settings != after.settings
    for variant in chain:
        assert isinstance(variant.applied(SCENE, None).method, DvctMethod)
