"""YAML becomes the dataclasses exactly, and whatever does not fit is named."""

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal

import pytest

from node.commands.config_file import from_mapping, load_config
from node.commands.options import LiveConfig, ReplayConfig

LAUNCH = Path(__file__).resolve().parents[3] / "launch"


@dataclass(frozen=True)
class Inner:
    width: float = 1.0
    turns: tuple[float, ...] = ()
    box: tuple[int, int] | None = None

    def __post_init__(self) -> None:
        if self.width <= 0:
            raise ValueError(f"width is {self.width}; give more than 0")


@dataclass(frozen=True)
class Outer:
    name: str
    count: int = 3
    loud: bool = False
    mode: Literal["fast", "slow"] = "fast"
    path: Path | None = None
    inner: Inner = field(default_factory=Inner)
    wide: Inner = field(default_factory=lambda: Inner(width=9.0))


def test_values_nest_and_the_rest_keeps_its_default() -> None:
    values = {"name": "a", "inner": {"width": 2, "turns": [1, 2.5]}, "path": "x/y", "mode": "slow"}
    assert from_mapping(Outer, values) == Outer("a", 3, False, "slow", Path("x/y"), Inner(2.0, (1.0, 2.5)))
    assert isinstance(from_mapping(Outer, values).inner.width, float)
    assert from_mapping(Outer, {"name": "a", "path": None}).path is None
    assert from_mapping(Outer, {"name": "a", "inner": {"box": [1, 2]}}).inner.box == (1, 2)


def test_what_is_omitted_keeps_the_default_of_its_place() -> None:
    """Which is not always that of its class: a node listens at an address of its own, and samples quickly."""
    assert from_mapping(Outer, {"name": "a", "wide": {"turns": [1]}}).wide == Inner(9.0, (1.0,))
    live = from_mapping(LiveConfig, {"bus": {"name": "a"}, "controller": {"infer": {"smc": {"particles": 4}}}})
    default = LiveConfig()
    assert live.bus == replace(default.bus, name="a")
    assert live.controller.infer.smc == replace(default.controller.infer.smc, particles=4)


@pytest.mark.parametrize(
    ("values", "says"),
    [
        ({"name": "a", "cuont": 1}, "unknown key cuont; did you mean count?"),
        ({"name": "a", "inner": {"widht": 1}}, "unknown key inner.widht; did you mean width?"),
        ({"name": "a", "zzzzzzzz": 1}, "its keys are name, count, loud, mode, path, inner, wide"),
        ({"name": "a", "count": 1.5}, "count is 1.5; give a whole number"),
        ({"name": "a", "count": True}, "count is True; give a whole number"),
        ({"name": "a", "loud": 1}, "loud is 1; give true or false"),
        ({"name": 3}, "name is 3; give a text"),
        ({"name": "a", "mode": "loud"}, "mode is 'loud'; give 'fast' or 'slow'"),
        ({"name": "a", "inner": {"width": "2"}}, "inner.width is '2'; give a number"),
        ({"name": "a", "inner": {"width": -1}}, "inner: width is -1.0; give more than 0"),
        ({"name": "a", "inner": 4}, "inner is 4; give a mapping with keys of width, turns, box"),
        ({"name": "a", "inner": {"turns": [1, "2"]}}, "inner.turns[1] is '2'; give a number"),
        ({"name": "a", "inner": {"turns": "12"}}, "inner.turns is '12'; give a list"),
        ({"name": "a", "inner": {"box": [1]}}, "inner.box is [1]; give more entries"),
        ({"name": "a", "inner": {"box": [1, 2, 3]}}, "inner.box is [1, 2, 3]; give 2 entries"),
        ({"name": "a", "path": 3}, "path is 3; give a "),
        ({}, "the file lacks name"),
        (["name"], "the file is ['name']; give a mapping"),
    ],
)
def test_what_does_not_fit_is_named(values: object, says: str) -> None:
    with pytest.raises(ValueError) as caught:
        from_mapping(Outer, values)
    assert says in str(caught.value) and "\n" not in str(caught.value)


def test_a_files_trouble_names_the_file(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"none\.yaml: no such configuration file"):
        load_config(tmp_path / "none.yaml", Outer)
    path = tmp_path / "a.yaml"
    path.write_text("name: [1\n")
    with pytest.raises(ValueError, match=r"a\.yaml is not YAML") as caught:
        load_config(path, Outer)
    assert "\n" not in str(caught.value)
    path.write_text("name: a\nmdoe: slow\n")
    with pytest.raises(ValueError, match=r"a\.yaml: unknown key mdoe; did you mean mode"):
        load_config(path, Outer)
    path.write_text("name: a\ninner:\n  width: 1\n  width: 2\n")
    with pytest.raises(ValueError, match=r"a\.yaml is not YAML \(line 4: .*key \"width\".*; omit one") as caught:
        load_config(path, Outer)
    assert "\n" not in str(caught.value)
    lines = [f"{y}: &{y} [{', '.join([f'*{x}'] * 99)}]\n" for x, y in ("ab", "bc", "cd")]
    path.write_text("name: &a [1]\n" + "".join(lines))
    with pytest.raises(ValueError, match=r"a\.yaml is not YAML \(it holds more than"):
        load_config(path, Outer)
    path.write_text("[" * 5000)
    with pytest.raises(ValueError, match=r"a\.yaml is not YAML"):
        load_config(path, Outer)
    path.write_text("name: on\ninner: {width: 5e-3}\n")  # as YAML 1.2 reads them
    assert load_config(path, Outer) == Outer("on", inner=Inner(0.005))
    path.write_text("")
    assert load_config(path, Inner) == Inner()


def test_the_launch_file_states_the_defaults() -> None:
    loaded = load_config(LAUNCH / "replay.yaml", ReplayConfig)
    assert loaded.budget == 90.0 and loaded != ReplayConfig()
    assert replace(loaded, budget=None, controller=ReplayConfig().controller) == ReplayConfig()
    assert loaded.controller == ReplayConfig().controller
