"""Every registered scene in turn."""

import pytest

from dnerf.scenes import SCENES, AnalyticScene, make_scene


@pytest.fixture(params=sorted(SCENES))
def name(request: pytest.FixtureRequest) -> str:
    return request.param


@pytest.fixture
def scene(name: str) -> AnalyticScene:
    return make_scene(name)
