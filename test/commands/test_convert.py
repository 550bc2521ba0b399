"""The command `convert`: what it writes, what it tells, what it refuses."""

from __future__ import annotations

import hashlib
import io
import os
import subprocess
import sys
from pathlib import Path

import pytest
from support.random_model import CLASS_NAMES, random_model
from support.refusals import Refused

from yolov5_lifecycle.checkpoints.locate import load_weights
from yolov5_lifecycle.checkpoints.safetensors_file import write_safetensors
from yolov5_lifecycle.commands.convert import main
from yolov5_lifecycle.ros.child_process import entry_point

OFFICIAL_PARAMETERS = "1,872,157"


@pytest.fixture
def source(tmp_path: Path) -> Path:
    """A valid input that needs no reference data; any file that the node reads can be converted."""
    path = tmp_path / "in.safetensors"
    write_safetensors(random_model(), path)
    return path


def test_a_conversion_prints_classes_parameters_and_digest(
    source: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    target = tmp_path / "out.safetensors"
    assert main([str(source), str(target)]) == 0
    told = capsys.readouterr()
    digest = hashlib.sha256(target.read_bytes()).hexdigest()
    network = sum(
        tensor.numel() for key, tensor in random_model().state_dict.items()
        if not key.endswith(("running_mean", "running_var", "num_batches_tracked", "anchors"))
    )  # fmt: skip
    assert told.err == ""
    assert told.out.splitlines() == [
        str(target),
        f"classes     {len(CLASS_NAMES)}: {', '.join(CLASS_NAMES)}",
        f"parameters  {network:,}",
        f"sha256      {digest}",
    ]


@pytest.mark.parametrize(
    ("source_name", "target_name", "told"),
    [
        pytest.param("missing.pt", "out.safetensors", "there is no such file", id="source missing"),
        pytest.param("broken.pt", "out.safetensors", "the file is empty", id="source broken"),
        pytest.param("in.safetensors", "out.pt", "expected a name that ends in .safetensors", id="suffix"),
        pytest.param("in.safetensors", "no/out.safetensors", "folder not found", id="no folder"),
        pytest.param("in.safetensors", "folder.safetensors", "folder.safetensors", id="target is a folder"),
    ],
)
def test_an_error_is_one_line_and_leaves_nothing_behind(
    source: Path, tmp_path: Path, refused: Refused, source_name: str, target_name: str, told: str
) -> None:
    (tmp_path / "broken.pt").touch()
    (tmp_path / "folder.safetensors").mkdir()
    line = refused.in_a_line(main, source_name, target_name, "--force")
    assert line.startswith("convert: ")
    assert told in line


@pytest.mark.parametrize("arguments", [["only.pt"], ["a.pt", "b", "--unknown"]], ids=str)
def test_wrong_usage_is_one_line(arguments: list[str], refused: Refused) -> None:
    line = refused.in_a_line(main, *arguments, code=2)
    assert line.startswith("convert: ")
    assert line.endswith("`convert --help` explains all arguments.")


@pytest.mark.long
@pytest.mark.parametrize("kind", ["file", "link to a file", "broken link"])
def test_whatever_is_there_is_kept_unless_forced_and_then_replaced(
    source: Path, tmp_path: Path, kind: str, capsys: pytest.CaptureFixture[str]
) -> None:
    """A link is replaced itself; what it leads to is not written."""
    target, precious = tmp_path / "out.safetensors", tmp_path / "precious"
    precious.write_bytes(b"precious")
    if kind == "file":
        target.write_bytes(b"old")
    else:
        target.symlink_to(precious if kind == "link to a file" else tmp_path / "nowhere")
    assert main([str(source), str(target)]) == 1
    assert "exists; give --force to replace it" in capsys.readouterr().err
    assert main([str(source), str(target), "--force"]) == 0
    assert target.is_file()
    assert not target.is_symlink()
    assert precious.read_bytes() == b"precious"
    assert not (tmp_path / "nowhere").exists()


def test_letters_that_the_terminal_lacks_are_escaped(
    source: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    output = io.BytesIO()
    monkeypatch.setattr(sys, "stdout", io.TextIOWrapper(output, encoding="ascii"))
    assert main([str(source), str(tmp_path / "größer.safetensors")]) == 0
    assert b"gr\\xf6\\xdfer.safetensors" in output.getvalue()


@pytest.mark.end_to_end
def test_the_official_model_is_converted_by_the_command(reference_dir: Path, tmp_path: Path) -> None:
    target = tmp_path / "yolov5n.safetensors"
    finished = subprocess.run(
        [entry_point("convert"), reference_dir / "weights" / "yolov5n.pt", target],
        capture_output=True,
        text=True,
        timeout=100,
        env=os.environ | {"PYTHONWARNINGS": "error"},
    )
    assert (finished.returncode, finished.stderr) == (0, "")
    assert f"parameters  {OFFICIAL_PARAMETERS}" in finished.stdout
    assert load_weights(target).sha256 in finished.stdout
