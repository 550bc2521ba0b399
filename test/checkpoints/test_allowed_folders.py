"""Weights are taken from the folders in `weights_dirs` alone, and nothing is told of other files."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest
from support.random_model import random_model
from support.served_node import ServedNode

from yolov5_lifecycle.checkpoints.locate import find_weights
from yolov5_lifecycle.checkpoints.safetensors_file import write_safetensors
from yolov5_lifecycle.detection.prepared_model import prepare_model
from yolov5_lifecycle.models.model import WeightsError
from yolov5_lifecycle.settings.settings import Settings

PACKAGED = "package://yolov5_lifecycle/weights"
MODEL = "yolov5n.safetensors"


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folders `inside` and `outside` with a model each, and links from each to the other."""
    root = tmp_path_factory.mktemp("root").resolve()
    for folder, other in (("inside", "outside"), ("outside", "inside")):
        (root / folder / "sub").mkdir(parents=True)
        write_safetensors(random_model(), root / folder / MODEL)
        (root / folder / "link.safetensors").symlink_to(root / other / MODEL)
        (root / folder / "linked").symlink_to(root / other)
        (root / folder / "dangling.safetensors").symlink_to(root / other / "gone.safetensors")
    (root / "inside" / "loop.safetensors").symlink_to("loop.safetensors")
    (root / "inside_too").mkdir()
    write_safetensors(random_model(), root / "inside_too" / MODEL)
    return root


def found(path: str | Path, *folders: Path) -> Path:
    return find_weights(weights=str(path), weights_dir=Path("/"), model_size="n", weights_dirs=folders)


def refusal(path: str | Path, *folders: Path) -> str:
    """What is said of `path`, its name left out."""
    with pytest.raises(WeightsError) as refused:
        found(path, *folders)
    message = str(refused.value)
    assert message.startswith(f"{path}: ")
    return message.removeprefix(f"{path}: ")


@pytest.mark.parametrize(
    ("path", "meant"),
    [
        pytest.param(f"inside/{MODEL}", f"inside/{MODEL}", id="plain"),
        pytest.param(f"inside/sub/../{MODEL}", f"inside/{MODEL}", id="dots"),
        pytest.param(f"nowhere/../inside/{MODEL}", f"inside/{MODEL}", id="dots-from-nowhere"),
        pytest.param("outside/link.safetensors", f"inside/{MODEL}", id="link-into"),
        pytest.param(f"outside/linked/{MODEL}", f"inside/{MODEL}", id="folder-link-into"),
        pytest.param("inside/missing.pt", "inside/missing.pt", id="missing"),
        pytest.param("inside/loop.safetensors", "inside/loop.safetensors", id="link-to-itself"),
    ],
)
def test_a_path_that_leads_inside_is_resolved(root: Path, path: str, meant: str) -> None:
    assert found(f"{root}/{path}", root / "elsewhere", root / "inside") == root / meant


@pytest.mark.parametrize(
    "path",
    [
        pytest.param(f"outside/{MODEL}", id="existing"),
        pytest.param("outside/missing.safetensors", id="missing"),
        pytest.param(f"inside/../outside/{MODEL}", id="dots"),
        pytest.param("inside/link.safetensors", id="link-out"),
        pytest.param("inside/dangling.safetensors", id="link-to-missing"),
        pytest.param(f"inside/linked/{MODEL}", id="folder-link-out"),
        pytest.param(f"inside_too/{MODEL}", id="name-that-begins-alike"),
        pytest.param("outside/a\0b.pt", id="NUL"),
    ],
)
def test_nothing_is_revealed_of_a_path_outside(root: Path, path: str) -> None:
    told = refusal(f"{root}/{path}", root / "inside")
    assert told == refusal("/no/such/file.pt", root / "inside")
    assert str(root / "inside") in told
    assert "outside" not in told


def test_nothing_is_revealed_of_a_home_folder(root: Path) -> None:
    assert refusal("~nobody-of-that-name/a.pt", root) == refusal("~root/a.pt", root)


def test_dots_are_not_followed_through_a_link_outside(root: Path) -> None:
    """Else the answer would tell that the link is there."""
    for name in ("linked", "missing"):
        assert (
            found(f"{root}/outside/{name}/../../inside/{MODEL}", root / "inside") == root / "inside" / MODEL
        )
        refusal(f"{root}/outside/{name}/../{MODEL}", root / "inside")


def searched(weights_dir: Path, model_size: str, *folders: Path) -> Path:
    return find_weights(weights="", weights_dir=weights_dir, model_size=model_size, weights_dirs=folders)


@pytest.mark.parametrize("size", ["n", "s"], ids=["existing", "missing"])
def test_a_folder_outside_is_not_searched(root: Path, size: str) -> None:
    with pytest.raises(WeightsError) as refused:
        searched(root / "outside", size, root / "inside")
    assert str(refused.value).removeprefix(f"{root}/outside: ") == refusal("/no/such.pt", root / "inside")


def test_the_folder_itself_is_searched(root: Path) -> None:
    assert searched(root / "inside", "n", root / "inside") == root / "inside" / MODEL
    with pytest.raises(WeightsError, match="no weights for model_size 's'"):
        searched(root / "inside", "s", root / "inside")


def test_a_folder_that_is_a_link_stands_for_its_target(root: Path) -> None:
    assert found(root / "outside" / MODEL, root / "inside" / "linked") == root / "outside" / MODEL


def test_a_tilde_in_a_folder_is_the_home_folder(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HOME", str(root))
    assert found(f"~/inside/{MODEL}", Path("~/inside")) == root / "inside" / MODEL
    assert "~/inside" in refusal("/no/such.pt", Path("~/inside"))


def test_a_packaged_model_may_be_allowed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("AMENT_PREFIX_PATH", sys.prefix)
    packaged = Settings(weights=f"{PACKAGED}/shapes.safetensors", weights_dirs=(PACKAGED,), device="cpu")
    prepare_model(packaged.model_copy(update={"runtime": "torch", "image_size": 64}), []).close()
    with pytest.raises(WeightsError, match="does not lie in a folder"):
        prepare_model(packaged.model_copy(update={"weights": f"{PACKAGED}/../README.md"}), [])


@pytest.mark.usefixtures("ros_domain")
def test_a_node_refuses_weights_from_outside_in_every_state(root: Path) -> None:
    inside, outside = root / "inside" / MODEL, root / "outside" / MODEL
    parameters = [f"weights:={outside}", f"weights_dirs:=['{root}/inside']", "image_size:=64", "device:=cpu"]
    with ServedNode(prepare_model, parameters=parameters) as served:
        assert not served.transition("configure")
        served.wait_for_log(f"configure refused: {outside}: it does not lie in a folder")
        assert served.set(weights=str(inside)) == (True, "")
        served.bring_to("active")
        refusals = []
        for name in (MODEL, "missing.pt"):
            done, reason = served.set(weights=f"{root}/outside/{name}")
            assert not done
            refusals.append(reason.replace(name, ""))
        assert refusals[0] == refusals[1]
        assert "does not lie in a folder" in refusals[0]
        assert served.get("weights") == str(inside)
        assert served.transition("deactivate")
        assert served.set(weights=str(outside)) == (True, "")
        assert not served.transition("activate")
        served.wait_for_log("activate refused: ")
        assert not served.set(weights_dirs=["/"])[0]
        assert served.get("weights_dirs") == [f"{root}/inside"]


@pytest.mark.usefixtures("ros_domain")
def test_invalid_folders_fail_configure_until_the_process_is_restarted() -> None:
    with ServedNode(prepare_model, parameters=["weights_dirs:=inside"]) as served:
        for others in (["/"], []):
            assert not served.set(weights_dirs=others)[0]
        assert not served.transition("configure")
        assert "weights_dirs: 'inside' is not a list" in served.status().message
