"""Detectors from damaged and hostile ONNX files: each is refused by its path, within limits of time and memory."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from rich.console import Console

from servotrack.baselines.agents.people import bounded_network
from servotrack.baselines.agents.people.onnx_detector import OnnxDetector
from servotrack.baselines.reporting.files import ResultsError
from servotrack.baselines.track_command.command import TrackRequest, run_command
from servotrack.baselines.track_command.opening import SourceRequest
from servotrack.envs.track.files.read import read_tracks

onnx = pytest.importorskip("onnx")
helper, FLOAT, INT64, BOOL = onnx.helper, onnx.TensorProto.FLOAT, onnx.TensorProto.INT64, onnx.TensorProto.BOOL
LISTED = (1, 300, 6)
LIMIT = 0.5
"""Time limit of a frame in these tests, s."""
TURNS, VALUES = 2**62, 2**31


def info(name: str, shape: Any, kind: int = FLOAT) -> Any:
    return helper.make_tensor_value_info(name, kind, shape)


def constant(name: str, value: Any) -> Any:
    return helper.make_node("Constant", [], [name], value=onnx.numpy_helper.from_array(np.asarray(value)))


def rows(**columns: float) -> np.ndarray:
    """Rows (left, top, right, bottom, score, class) of a detector with suppression built in."""
    found = np.zeros(LISTED, np.float32)
    for name, value in {"right": 10.0, "bottom": 10.0, "score": 0.9, **columns}.items():
        found[0, :, ("left", "top", "right", "bottom", "score", "class").index(name)] = value
    return found


def network(nodes: Iterable[Any], functions: Iterable[Any] = (), **metadata: str) -> bytes:
    graph = helper.make_graph(list(nodes), "network", [info("images", (1, 3, 64, 64))], [info("output0", None)])
    opsets = [helper.make_opsetid("", 17), helper.make_opsetid("own", 1)]
    model = helper.make_model(graph, opset_imports=opsets, ir_version=9, functions=list(functions))
    helper.set_model_props(model, {"names": "{0: 'person'}", **metadata})
    content: bytes = model.SerializeToString()
    return content


def answering(value: np.ndarray, **metadata: str) -> bytes:
    return network([constant("output0", value)], **metadata)


def with_maximum(name: str, *nodes: Any) -> bytes:
    """A network that adds the largest number of a tensor to its rows."""
    return network(
        [
            *nodes,
            helper.make_node("ReduceMax", [name], ["largest"], keepdims=0),
            constant("rows", rows()),
            helper.make_node("Add", ["rows", "largest"], ["output0"]),
        ]
    )


def loop() -> bytes:
    body = helper.make_graph(
        [helper.make_node("Identity", ["go"], ["goes"]), helper.make_node("Identity", ["value"], ["next"])],
        "body",
        [info("turn", (), INT64), info("go", (), BOOL), info("value", LISTED)],
        [info("goes", (), BOOL), info("next", LISTED)],
    )
    nodes = [constant("turns", np.int64(TURNS)), constant("yes", np.bool_(True)), constant("rows", rows())]
    return network([*nodes, helper.make_node("Loop", ["turns", "yes", "rows"], ["output0"], body=body)])


def large(operator: str) -> bytes:
    inputs = {
        "ConstantOfShape": [[VALUES]],
        "Expand": [np.float32([1]), [VALUES]],
        "Tile": [np.float32([1]), [VALUES]],
        "Range": [np.int64(0), np.int64(2**40), np.int64(1)],
    }[operator]
    constants = [constant(f"input{k}", value) for k, value in enumerate(inputs)]
    names = [f"input{k}" for k in range(len(inputs))]
    cast = helper.make_node("Cast", ["wide"], ["floats"], to=FLOAT)
    return with_maximum("floats", *constants, helper.make_node(operator, names, ["wide"]), cast)


def products() -> bytes:
    first = helper.make_node("Resize", ["images", "", "scales"], ["p0"], mode="nearest")
    scales = constant("scales", np.float32([1, 1, 12, 12]))
    chain = [helper.make_node("MatMul", [f"p{k}", f"p{k}"], [f"p{k + 1}"]) for k in range(1000)]
    return with_maximum("p1000", scales, first, *chain)


def functions(own: Callable[[int], str]) -> bytes:
    made = []
    for k in range(30):
        called = own(k)
        twice = [("x", "y0"), ("y0", "y")]
        nodes = [helper.make_node(called, [a], [b], domain="own" if called != "Identity" else "") for a, b in twice]
        opsets = [helper.make_opsetid("", 17), helper.make_opsetid("own", 1)]
        made.append(helper.make_function("own", f"f{k}", ["x"], ["y"], nodes, opsets))
    return network([constant("rows", rows()), helper.make_node("f29", ["rows"], ["output0"], domain="own")], made)


def sequence() -> bytes:
    return network([constant("rows", rows()), helper.make_node("SequenceConstruct", ["rows"], ["output0"])])


MEMORY = "needs more than 4 GiB|more than 4294967296 bytes"
CASES: dict[str, tuple[Callable[[], bytes], str]] = {
    "loop of 2^62 turns": (loop, "needs more than .* s for a frame"),
    "chain of products": (products, "needs more than .* s for a frame"),
    "30 functions that double": (lambda: functions(lambda k: f"f{k - 1}" if k else "Identity"), "200000 nodes"),
    "functions in a circle": (lambda: functions(lambda k: f"f{(k - 1) % 30}"), "call themselves"),
    **{f"{name} of 8 GiB": (lambda name=name: large(name), MEMORY) for name in ("ConstantOfShape", "Expand", "Tile")},
    "Range of 2^40": (lambda: large("Range"), MEMORY),
    "sequence": (sequence, "output0 must be an array of numbers|cannot be run"),
    "text": (lambda: answering(np.array([["a"] * 6], dtype=object)), "output0 must be an array of numbers"),
    "NaN": (lambda: answering(rows(score=np.nan)), "gives NaN in output0"),
    "infinite score": (lambda: answering(rows(score=np.inf)), "a confidence inf"),
    "score of 5": (lambda: answering(rows(score=5.0)), "a confidence 5.0"),
    "corners far away": (lambda: answering(rows(left=-3e38, right=3e38)), "a corner"),
    "infinite corner": (lambda: answering(rows(bottom=np.inf)), "a corner"),
    "class of 1e30": (lambda: answering(rows(**{"class": 1e30})), "a class"),
    "metadata that is not UTF-8": (
        lambda: answering(rows(), names="@@@@").replace(b"@@@@", b"\xff\xfe\xfd\xfc"),
        "cannot be run",
    ),
    "name that is not UTF-8": (lambda: answering(rows()).replace(b"output0", b"outp\xff\xfe\xfd"), "cannot be run"),
}


@pytest.fixture(autouse=True)
def short_runs(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bounded_network, "LONGEST_RUN", LIMIT)


def written(path: Path, content: bytes) -> Path:
    path.write_bytes(content)
    return path


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("name", CASES)
def test_hostile_networks_end_by_a_message(name: str, tmp_path: Path) -> None:
    make, message = CASES[name]
    path = written(tmp_path / "evil.onnx", make())
    begin = time.process_time()
    with pytest.raises(ResultsError, match=rf"evil\.onnx.*({message})") as caught:
        OnnxDetector(path).detect(np.zeros((48, 64, 3), np.uint8))
    assert "\n" not in str(caught.value) and len(str(caught.value)) < 400
    assert time.process_time() - begin < 5.0


@pytest.mark.parametrize(
    "names",
    [
        "(" * 50_000, "-" * 90_000 + "1", "1+" * 45_000 + "1", "{{}}", "{[]: 1}", f"{{'{'9' * 5000}': 'a'}}",
        f"{{0x{'f' * 20_000}: 'a'}}", f"{{0: 0x{'f' * 20_000}}}", "{-1: 'a'}", "{'x': 'a'}", "{0: ['a']}",
    ],
)  # fmt: skip
def test_names_of_any_kind_are_read_or_ignored(names: str, tmp_path: Path) -> None:
    path = written(tmp_path / "a.onnx", answering(rows(), names=names, imgsz=f"[0x{'f' * 20_000}, 1]"))
    detector = OnnxDetector(path, [0])
    assert detector.names == {} and detector.size == (64, 64)


def test_scores_above_one_by_rounding_are_probabilities(tmp_path: Path) -> None:
    detector = OnnxDetector(written(tmp_path / "a.onnx", answering(rows(score=1.0005))))
    assert detector.detect(np.zeros((64, 64, 3), np.uint8))[0].confidences.max() == 1.0


def test_a_network_that_fails_later_leaves_the_tracks_so_far(tmp_path: Path) -> None:
    # The root of a negative number, where the image is bright.
    dark = network(
        [
            constant("half", np.float32(0.5)),
            constant("zero", np.float32(0.0)),
            constant("rows", rows()),
            helper.make_node("ReduceMax", ["images"], ["largest"], keepdims=0),
            helper.make_node("Sub", ["half", "largest"], ["left"]),
            helper.make_node("Sqrt", ["left"], ["root"]),
            helper.make_node("Mul", ["root", "zero"], ["nothing"]),
            helper.make_node("Add", ["rows", "nothing"], ["output0"]),
        ]
    )
    folder = tmp_path / "frames"
    folder.mkdir()
    for k in range(8):
        cv2.imwrite(str(folder / f"{k}.png"), np.full((64, 64, 3), 255 if k == 5 else 0, np.uint8))
    source = SourceRequest(str(folder), str(written(tmp_path / "dark.onnx", dark)))
    with Console(quiet=True) as console:
        assert run_command(TrackRequest(source, tmp_path / "out", "no-filter", video=False), console) == 1
    assert len(read_tracks(tmp_path / "out" / "tracks.txt").ids)
    assert {path.name for path in (tmp_path / "out").iterdir()} == {"track.json", "tracks.txt"}
