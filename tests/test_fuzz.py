"""Readers of others' files under mutated inputs: a documented error or a good result; and the cases found."""

import random
from pathlib import Path

import fuzz_readers
import pytest
from fuzz_readers import Reader
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from dnerf.training.runs import load_config


@pytest.fixture(scope="module", params=sorted(fuzz_readers.READERS))
def reader(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Reader:
    return fuzz_readers.READERS[request.param](tmp_path_factory.mktemp("fuzz") / "files")


@settings(max_examples=100, suppress_health_check=list(HealthCheck))
@given(chance=st.randoms(use_true_random=True, note_method_calls=False))
def test_mutated_inputs_give_documented_errors_within_bounds(reader: Reader, chance: random.Random) -> None:
    assert fuzz_readers.read_spoilt(reader, chance) is None


@pytest.mark.parametrize("name", sorted(fuzz_readers.READERS))
def test_the_fuzzer_notices_what_it_looks_for(name: str, tmp_path: Path) -> None:
    """Most mutations are refused, some are harmless: otherwise the fuzzer would test nothing."""
    reader, refused = fuzz_readers.READERS[name](tmp_path / "files"), 0
    for seed in range(100):
        try:
            reader(random.Random(seed))
        except ValueError:
            refused += 1
    assert 30 <= refused < 100

    def broken(chance: random.Random) -> None:
        raise KeyError("frames")

    assert fuzz_readers.read_spoilt(broken, random.Random(0)) == "KeyError: 'frames'"


@pytest.mark.parametrize(
    "text",
    [
        pytest.param("null", id="nothing at all: TypeError"),
        pytest.param("- renderer\n- data\n", id="a list"),
        pytest.param("renderer: null\ndata: null\n", id="nothing inside"),
        pytest.param("renderer: {}\ndata: &a {x: [1]}\nother: *a\n", id="an alias"),
        pytest.param(
            "a: &a [1,1,1,1,1,1,1,1,1,1]\n"
            + "".join(f"{b}: &{b} [{','.join(['*' + a] * 10)}]\n" for a, b in zip("abcdefghi", "bcdefghij"))
            + "renderer: {}\ndata: {}\n",
            id="aliases that unfold to 10^10 numbers",
        ),
        pytest.param("data: {}\nrenderer: " + "[" * 30000, id="30000 levels: minutes"),
        pytest.param("data: {}\nrenderer: {x: " + "y" * 2**20 + "}", id="a megabyte"),
        pytest.param("data: {}\nrenderer: !!python/object/apply:os.system ['true']", id="a Python object"),
        pytest.param("data: {}\nrenderer: {_target_: builtins.exec, _args_: ['1']}", id="a target outside"),
        pytest.param("data: {a: [{b: {_target_: os.system}}]}\nrenderer: {}", id="a target deep inside"),
    ],
)
def test_hostile_configs_are_refused_at_once(tmp_path: Path, text: str) -> None:
    (tmp_path / "config.yaml").write_text(text)
    with pytest.raises(ValueError, match=r"config\.yaml") as error:
        load_config(tmp_path)
    assert "\n" not in str(error.value)
