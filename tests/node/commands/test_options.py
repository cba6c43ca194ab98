"""Options are the fields of the dataclasses that files fill; help is short, complete on request, and quick."""

import json
import subprocess
import sys
from dataclasses import asdict, fields

import pytest

from node.__main__ import main
from node.commands.batch_options import BatchConfig
from node.commands.config_file import from_mapping
from node.commands.options import LiveConfig, ReplayConfig, options_of


@pytest.mark.parametrize("kind", [ReplayConfig, LiveConfig, BatchConfig])
def test_options_and_keys_are_fields_of_one_dataclass(kind: type) -> None:
    """What a file may hold is what the command line reads, but for --config; and the whole of it comes back."""
    options = {f.name for f in fields(options_of(kind, hidden=False))}
    assert options == {f.name for f in fields(kind)} | {"config"}
    everything = json.loads(json.dumps(asdict(kind()), default=str))
    assert from_mapping(kind, everything) == kind()
    with pytest.raises(ValueError, match="unknown key config"):
        from_mapping(kind, {"config": "other.yaml"})


@pytest.mark.parametrize("command", ["replay", "live", "batch"])
def test_nested_settings_are_listed_on_request_alone(capsys: pytest.CaptureFixture, command: str) -> None:
    text = {}
    for option in ("--help", "--help-all"):
        with pytest.raises(SystemExit) as ended:
            main([command, option])
        assert ended.value.code == 0
        text[option] = capsys.readouterr().out
    assert "--controller" not in text["--help"] and "--help-all" in text["--help"]
    assert "--controller.runs" in text["--help-all"] and "--seed" in text["--help-all"]


def test_help_and_mistyped_options_load_nothing_heavy() -> None:
    """Neither JAX, nor OpenCV, nor NumPy: they answer at once."""
    code = """
import sys
from node.__main__ import COMMANDS, main
for command in COMMANDS:
    for option in ("--help", "--mistyped"):
        try:
            command == "bench" or main([command, option])
        except SystemExit:
            pass
assert not {"jax", "cv2", "numpy"} & set(sys.modules), sorted(sys.modules)
"""
    ended = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert ended.returncode == 0, ended.stderr
