"""Detectors from ONNX files: every kind of output on networks made here, against plain post-processing in loops."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from rich.console import Console

from servotrack.baselines.agents.people.onnx_detector import OnnxDetector
from servotrack.baselines.reporting.files import ResultsError
from servotrack.baselines.track_command.command import TrackRequest, run_command
from servotrack.baselines.track_command.opening import SourceRequest
from servotrack.envs.track.files.read import read_tracks
from servotrack.estimators.detect.network_frames import letterbox, non_maximum_suppression, stretch
from servotrack.estimators.testing import FrameInputs, check_estimator

onnx = pytest.importorskip("onnx")
SIDE = 64
CELLS = 8 * 8 + 4 * 4 + 2 * 2
COCO = {0: "person", 1: "bicycle", 2: "car"}


def constant_network(
    path: Path,
    outputs: dict[str, np.ndarray],
    metadata: dict[str, str] | None = None,
    size_name: str | None = None,
    image: tuple = (1, 3, SIDE, SIDE),
    kind: int = onnx.TensorProto.FLOAT,
) -> Path:
    """Write a network whose outputs do not depend on the image."""
    helper, types = onnx.helper, onnx.TensorProto
    inputs = [helper.make_tensor_value_info("images", kind, image)]
    if size_name:
        inputs.append(helper.make_tensor_value_info(size_name, types.INT64, (1, 2)))
    nodes, ports = [], []
    for name, values in outputs.items():
        tensor = onnx.numpy_helper.from_array(values, name + "_value")
        nodes.append(helper.make_node("Constant", [], [name], value=tensor))
        ports.append(helper.make_tensor_value_info(name, tensor.data_type, values.shape))
    graph = helper.make_graph(nodes, "network", inputs, ports)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
    helper.set_model_props(model, metadata or {})
    onnx.save(model, str(path))
    return path


def random_boxes(rng: np.random.Generator, count: int) -> np.ndarray:
    """Return centers and sizes, px of the input; many overlap."""
    return np.concatenate([rng.uniform(5, SIDE - 5, (count, 2)), rng.uniform(8, 25, (count, 2))], axis=1).astype(
        np.float32
    )


def plain_detections(
    boxes: np.ndarray, scores: np.ndarray, wanted: int, frame: tuple[int, int], least: float, overlap: float
) -> list[tuple[float, ...]]:
    """Return (left, top, width, height, score) by loops over boxes, from the definition of each step."""
    gain = min(SIDE / frame[0], SIDE / frame[1])
    inner = round(frame[0] * gain), round(frame[1] * gain)
    across, down = (SIDE - inner[0]) // 2, (SIDE - inner[1]) // 2
    gains = inner[0] / frame[0], inner[1] / frame[1]
    rows = []
    for (x, y, w, h), row in zip(boxes.tolist(), scores.tolist(), strict=True):
        best = max(range(len(row)), key=lambda k: row[k])
        if best == wanted and row[best] > least:
            rows.append((row[best], x - w / 2, y - h / 2, x + w / 2, y + h / 2))
    kept: list[tuple[float, ...]] = []
    for row in sorted(rows, reverse=True):
        clear = True
        for other in kept:
            shared = max(0.0, min(row[3], other[3]) - max(row[1], other[1])) * max(
                0.0, min(row[4], other[4]) - max(row[2], other[2])
            )
            union = (row[3] - row[1]) * (row[4] - row[2]) + (other[3] - other[1]) * (other[4] - other[2]) - shared
            clear = clear and shared / union <= overlap
        if clear:
            kept.append(row)
    found = []
    for score, left, top, right, bottom in kept:
        left, right = (min(max((v - across) / gains[0], 0.0), frame[0]) for v in (left, right))
        top, bottom = (min(max((v - down) / gains[1], 0.0), frame[1]) for v in (top, bottom))
        found.append((left, top, right - left, bottom - top, score))
    return found


def check_detections(path: Path, frame: tuple[int, int], expected: list[tuple[float, ...]], **options: object) -> None:
    detector = OnnxDetector(path, **options)
    black = np.zeros((frame[1], frame[0], 3), np.uint8)
    state, found = detector.step(detector.initial(black), black)
    assert state == black.shape and len(expected) > 0
    got = [(*box, score) for box, score in zip(found.boxes.tolist(), found.confidences.tolist(), strict=True)]
    assert got == [pytest.approx(row, abs=2e-4) for row in expected]


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("form", ["v8", "v8 without names", "v5", "v5 without names", "rows without objectness"])
def test_dense_heads_with_suppression(tmp_path, seed, form):
    rng = np.random.default_rng(seed)
    count = 3 * CELLS if form.startswith("v5") else CELLS
    boxes, scores = random_boxes(rng, count), rng.random((count, 3)).astype(np.float32) ** 2
    objects = rng.random((count, 1)).astype(np.float32)
    if form.startswith("v5"):
        output, scores = np.concatenate([boxes, objects, scores], axis=1)[None], scores * objects
    else:
        output = np.concatenate([boxes, scores], axis=1)[None]
        output = output if form.startswith("rows") else output.transpose(0, 2, 1)
    named = {} if "without names" in form else {"names": str(COCO)}
    path = constant_network(tmp_path / "a.onnx", {"output0": np.ascontiguousarray(output)}, named)
    frame = [(128, 96), (33, 90), (64, 64), (200, 61)][seed]
    options = {"confidence": 0.2, "overlap": 0.5, "classes": ["0"] if not named else None}
    check_detections(path, frame, plain_detections(boxes, scores, 0, frame, 0.2, 0.5), **options)
    assert OnnxDetector(path, classes=["2"]).head.objectness == form.startswith("v5")


def test_listed_boxes_need_no_suppression(tmp_path):
    rows = np.zeros((1, 300, 6), np.float32)
    rows[0, :3] = [[8, 20, 24, 52, 0.9, 0], [8, 20, 24, 51, 0.8, 0], [30, 30, 40, 40, 0.7, 2]]
    path = constant_network(tmp_path / "a.onnx", {"output0": rows}, {"names": str(COCO), "imgsz": "[64, 64]"})
    # 128 x 96 fits at half the size, with borders of 8 px above and below.
    check_detections(path, (128, 96), [(16, 24, 32, 64, 0.9), (16, 24, 32, 62, 0.8)])
    assert OnnxDetector(path).head.kind == "listed"


@pytest.mark.parametrize("told", [True, False])
def test_chosen_queries_are_centers_in_fractions(tmp_path, told):
    rows = np.zeros((1, 300, 6), np.float32)
    rows[0, :2] = [[0.5, 0.4, 0.2, 0.4, 0.9, 0], [0.5, 0.4, 0.2, 0.4, 0.8, 2]]
    metadata = {"names": str(COCO), "stride": "32"} | ({"head": "RTDETRDecoder"} if told else {})
    path = constant_network(tmp_path / "a.onnx", {"output0": rows}, metadata)
    check_detections(path, (200, 100), [(80, 20, 40, 40, 0.9)])
    assert OnnxDetector(path).head.kind == "chosen"


def test_queries_and_logits_are_fractions_of_a_stretched_frame(tmp_path):
    rng = np.random.default_rng(0)
    boxes = np.concatenate([rng.uniform(0.2, 0.8, (20, 2)), rng.uniform(0.1, 0.3, (20, 2))], axis=1).astype(np.float32)
    logits = rng.normal(0, 2, (20, 3)).astype(np.float32)
    scores = 1 / (1 + np.exp(-logits))
    rows = np.concatenate([boxes, scores], axis=1)[None]
    expected = sorted(
        (
            (float((x - w / 2) * 200), float((y - h / 2) * 100), float(w * 200), float(h * 100), float(row[0]))
            for (x, y, w, h), row in zip(boxes, scores, strict=True)
            if row.argmax() == 0 and row[0] > 0.4
        ),
        key=lambda row: -row[4],
    )
    one = constant_network(tmp_path / "a.onnx", {"output0": rows}, {"names": str(COCO), "stride": "32"})
    two = constant_network(tmp_path / "b.onnx", {"logits": logits[None], "pred_boxes": boxes[None]})
    check_detections(one, (200, 100), expected, confidence=0.4)
    check_detections(two, (200, 100), expected, confidence=0.4, classes=[0])
    assert (OnnxDetector(one).head.kind, OnnxDetector(two, classes=[0]).head.kind) == ("queries", "logits")


def test_two_classes_of_queries_are_not_taken_for_a_list(tmp_path):
    rows = np.random.default_rng(0).uniform(0.1, 0.9, (1, 30, 6)).astype(np.float32)
    path = constant_network(tmp_path / "a.onnx", {"output0": rows}, {"names": "{0: 'person', 1: 'dog'}"})
    assert OnnxDetector(path).head.kind == "queries"


def scaling_network(path: Path) -> Path:
    """Write a network in the form of D-FINE, whose box is the left half of the frame that it is told."""
    helper, types = onnx.helper, onnx.TensorProto
    share = onnx.numpy_helper.from_array(np.float32([[[0.0, 0.0, 0.5, 1.0]]]), "share")
    labels = onnx.numpy_helper.from_array(np.array([[0]], np.int64), "label")
    scores = onnx.numpy_helper.from_array(np.float32([[0.8]]), "score")
    nodes = [
        helper.make_node("Cast", ["orig_target_sizes"], ["size"], to=types.FLOAT),
        helper.make_node("Concat", ["size", "size"], ["twice"], axis=1),
        helper.make_node("Mul", ["share", "twice"], ["boxes"]),
        helper.make_node("Identity", ["label"], ["labels"]),
        helper.make_node("Identity", ["score"], ["scores"]),
    ]
    inputs = [
        helper.make_tensor_value_info("images", types.FLOAT, ("N", 3, SIDE, SIDE)),
        helper.make_tensor_value_info("orig_target_sizes", types.INT64, ("N", 2)),
    ]
    outputs = [
        helper.make_tensor_value_info("labels", types.INT64, (1, 1)),
        helper.make_tensor_value_info("boxes", types.FLOAT, (1, 1, 4)),
        helper.make_tensor_value_info("scores", types.FLOAT, (1, 1)),
    ]
    graph = helper.make_graph(nodes, "network", inputs, outputs, [share, labels, scores])
    onnx.save(helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8), str(path))
    return path


def test_network_that_is_told_the_size_answers_in_px_of_the_frame(tmp_path):
    path = scaling_network(tmp_path / "a.onnx")
    check_detections(path, (300, 40), [(0, 0, 150, 40, 0.8)], classes=[0])
    assert OnnxDetector(path, classes=[0]).head.kind == "scaled"
    check_estimator(OnnxDetector(path, classes=[0]), FrameInputs())


def finding_network(path: Path) -> Path:
    """Write a network that lists the box around the bright pixels of its input."""
    helper, types, numpy_helper = onnx.helper, onnx.TensorProto, onnx.numpy_helper
    at = np.arange(SIDE, dtype=np.float32)
    constants = {
        "level": np.float32(0.8), "at": at, "next": at + 1, "far": np.float32(1e4), "shape": np.array([1, 1, 1]),
        "rest": np.float32([[[0.9, 0.0]]]), "minus": np.float32(-1e4),
    }  # fmt: skip
    make = helper.make_node
    nodes = [
        make("ReduceMean", ["images"], ["gray"], axes=[0, 1], keepdims=0),
        make("Greater", ["gray", "level"], ["on"]),
        make("Cast", ["on"], ["mask"], to=types.FLOAT),
    ]
    for side, axis in (("x", 0), ("y", 1)):
        nodes += [
            make("ReduceMax", ["mask"], [f"{side}_line"], axes=[axis], keepdims=0),
            make("Cast", [f"{side}_line"], [f"{side}_on"], to=types.BOOL),
            make("Where", [f"{side}_on", "at", "far"], [f"{side}_first"]),
            make("Where", [f"{side}_on", "next", "minus"], [f"{side}_last"]),
            make("ReduceMin", [f"{side}_first"], [f"{side}_low_"], keepdims=0),
            make("ReduceMax", [f"{side}_last"], [f"{side}_high_"], keepdims=0),
            make("Reshape", [f"{side}_low_", "shape"], [f"{side}_low"]),
            make("Reshape", [f"{side}_high_", "shape"], [f"{side}_high"]),
        ]
    nodes.append(make("Concat", ["x_low", "y_low", "x_high", "y_high", "rest"], ["output0"], axis=2))
    graph = helper.make_graph(
        nodes, "network", [helper.make_tensor_value_info("images", types.FLOAT, (1, 3, SIDE, SIDE))],
        [helper.make_tensor_value_info("output0", types.FLOAT, (1, 1, 6))],
        [numpy_helper.from_array(np.asarray(value), name) for name, value in constants.items()],
    )  # fmt: skip
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
    helper.set_model_props(model, {"names": str(COCO)})
    onnx.save(model, str(path))
    return path


@pytest.mark.parametrize("size", [(128, 96), (96, 128), (64, 64), (640, 200), (47, 61)])
def test_bright_box_is_found_where_it_is(tmp_path, size):
    detector = OnnxDetector(finding_network(tmp_path / "a.onnx"))
    width, height = size
    left, top, right, bottom = width // 4, height // 4, width // 2, 3 * height // 4
    frame = np.zeros((height, width, 3), np.uint8)
    frame[top:bottom, left:right] = 255
    (box,) = detector.detect(frame)[0].boxes
    # A pixel of the input is max(size) / 64 px of the frame.
    assert np.abs(box - [left, top, right - left, bottom - top]).max() <= 1.5 * max(size) / SIDE


def test_letterbox_centers_the_frame_and_scales_it_once():
    frame = np.random.default_rng(0).integers(0, 256, (30, 61, 3)).astype(np.uint8)
    boxed, place = letterbox(frame, (64, 64))
    inner = round(30 * 64 / 61)
    assert boxed.shape == (64, 64, 3) and place.scale == (64 / 61, inner / 30)
    top = (64 - inner) // 2
    assert place.offset == (0.0, float(top))
    assert (boxed[:top] == 114).all() and (boxed[top + inner :] == 114).all()
    assert (boxed[top : top + inner] != 114).any(axis=(1, 2)).all()
    same, _ = letterbox(frame, (61, 30))
    np.testing.assert_array_equal(same, frame)
    corners = np.float32([[10, 5, 40, 25]])
    back = place.to_frame(corners * np.float32([64 / 61, inner / 30] * 2) + np.float32([0, top, 0, top]))
    np.testing.assert_allclose(back, corners, atol=1e-4)


def test_stretched_frame_is_pillows():
    frame = np.random.default_rng(0).integers(0, 256, (90, 61, 3)).astype(np.uint8)
    found, place = stretch(frame, (32, 20), smooth=True)
    np.testing.assert_array_equal(found, np.asarray(Image.fromarray(frame).resize((32, 20), Image.Resampling.BILINEAR)))
    np.testing.assert_allclose(place.to_frame(np.float32([[0, 0, 32, 20]])), [[0, 0, 61, 90]], atol=1e-4)


def test_suppression_keeps_classes_apart_and_takes_the_best_first():
    corners = np.float32([[0, 0, 10, 10], [0, 0, 10, 10], [0, 0, 10, 10], [20, 0, 30, 10]])
    kept = non_maximum_suppression(corners, np.float32([0.5, 0.9, 0.8, 0.1]), np.array([0, 0, 1, 0]), 0.5, 10)
    assert kept.tolist() == [1, 2, 3]
    kept = non_maximum_suppression(corners, np.float32([0.5, 0.9, 0.8, 0.1]), np.array([0, 0, 1, 0]), 0.5, 2)
    assert kept.tolist() == [1, 2]


def test_classes_by_name_or_number(tmp_path):
    rows = np.zeros((1, 300, 6), np.float32)
    rows[0, :3] = [[1, 1, 9, 9, 0.9, 0], [11, 11, 19, 19, 0.8, 1], [21, 21, 29, 29, 0.7, 2]]
    path = constant_network(tmp_path / "a.onnx", {"output0": rows}, {"names": str(COCO)})
    frame = np.zeros((64, 64, 3), np.uint8)
    for classes, found in ((None, [0]), (["Car"], [2]), (["bicycle", "0"], [0, 1]), ([1, 2], [1, 2])):
        assert OnnxDetector(path, classes).detect(frame)[1].tolist() == found
    with pytest.raises(ValueError, match=r"has no class 'dog'; known are person, bicycle, car"):
        OnnxDetector(path, ["dog"])
    other = constant_network(tmp_path / "b.onnx", {"output0": rows}, {"names": "{0: 'cat', 1: 'dog'}"})
    with pytest.raises(ValueError, match=r"has no class 'person' \(known are cat, dog\); give its classes"):
        OnnxDetector(other)
    bare = constant_network(tmp_path / "c.onnx", {"output0": rows})
    with pytest.raises(ValueError, match=r"it names none\); give its classes .* people at 0 \(80 classes\) or 1"):
        OnnxDetector(bare)
    evil = constant_network(tmp_path / "d.onnx", {"output0": rows}, {"names": "__import__('os').abort()"})
    assert OnnxDetector(evil, [0]).names == {}


@pytest.mark.parametrize(
    ("outputs", "image", "message"),
    [
        ({"out": np.zeros((1, 1000), np.float32)}, (1, 3, SIDE, SIDE), r"outputs out \(1, 1000\) are of no known"),
        ({"out": np.zeros((1, 300, 6), np.float32)}, (1, 1, SIDE, SIDE), "must be one RGB image"),
        ({"out": np.zeros((1, 300, 6), np.float32)}, (2, 3, SIDE, SIDE), "must be one RGB image"),
        ({"out": np.zeros((1, 300, 6), np.float32)}, (1, 3, 9000, SIDE), "sides from 32 to 8192 px"),
    ],
)
def test_other_networks_are_refused_with_what_they_have(tmp_path, outputs, image, message):
    with pytest.raises(ValueError, match=message):
        OnnxDetector(constant_network(tmp_path / "a.onnx", outputs, image=image), [0])


def test_files_that_are_no_network_of_their_own_are_refused(tmp_path):
    rows = {"output0": np.zeros((1, 300, 6), np.float32)}
    path = constant_network(tmp_path / "a.onnx", rows, {"names": str(COCO)})
    model = onnx.load(str(path))
    model.graph.initializer.append(onnx.numpy_helper.from_array(np.zeros((64, 64), np.float32), "weights"))
    onnx.save(model, str(tmp_path / "b.onnx"), save_as_external_data=True, location="weights.bin", size_threshold=0)
    (tmp_path / "c.onnx").write_bytes(b"no network")
    (tmp_path / "d.onnx").write_bytes(path.read_bytes()[:-20])
    (tmp_path / "e.onnx").write_bytes(b"\0\0\0\0ORTM" + bytes(99))
    (tmp_path / "f.onnx").mkdir()
    for name, message in {
        "b": "its weights are in another file", "c": "not an ONNX file", "d": "cannot be", "e": "own format",
        "f": "not a regular file|cannot be read", "nowhere": "cannot be read",
    }.items():  # fmt: skip
        with pytest.raises(ResultsError, match=rf"{name}\.onnx.*({message})"):
            OnnxDetector(tmp_path / f"{name}.onnx")
    with pytest.raises(ValueError, match=r"confidence must lie in \[0, 1\], got 2"):
        OnnxDetector(path, confidence=2)


def test_half_precision_dynamic_size_and_gray_frames(tmp_path):
    rows = np.zeros((1, 300, 6), np.float32)
    rows[0, 0] = [0, 0, 320, 160, 0.9, 0]
    path = constant_network(
        tmp_path / "a.onnx", {"output0": rows}, {"names": str(COCO), "imgsz": "[160, 320]"},
        image=("N", 3, "h", "w"), kind=onnx.TensorProto.FLOAT16,
    )  # fmt: skip
    detector = OnnxDetector(path)
    assert detector.size == (320, 160)
    np.testing.assert_allclose(detector.detect(np.zeros((80, 160), np.uint8))[0].boxes, [[0, 0, 160, 80]], atol=1e-3)


def test_track_command_takes_a_network(tmp_path):
    folder = tmp_path / "frames"
    folder.mkdir()
    for k in range(12):
        frame = np.zeros((96, 128, 3), np.uint8)
        frame[24:72, 8 * k : 8 * k + 24] = 255
        Image.fromarray(frame).save(folder / f"{k:03}.png")
    network = finding_network(tmp_path / "a.onnx")
    source = SourceRequest(str(folder), str(network), ("person",), 0.5)
    request = TrackRequest(source, tmp_path / "out", video=False)
    assert run_command(request, Console(quiet=True)) == 0
    (track,) = read_tracks(tmp_path / "out" / "tracks.txt").tracks
    expected = np.array([[8 * k, 24, 24, 48] for k in range(12)], float)[track.steps]
    assert len(track.steps) >= 9 and np.abs(track.states - expected).max() < 6
    for wrong, message in (
        (SourceRequest(str(folder), "masked", ("car",)), r"classes are for networks .* of masked have none"),
        (SourceRequest(str(folder), "masked", None, 0.5), "confidence is for networks and files; masked gives none"),
    ):
        with pytest.raises(ValueError, match=message):
            run_command(TrackRequest(wrong, tmp_path / "b"), Console(quiet=True))


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(6))
def test_equal_to_the_exporting_library_to_the_pixel(tmp_path, seed):
    """Letterbox, suppression and scaling back of ultralytics, where it is installed; it is no dependency."""
    torch = pytest.importorskip("torch")
    augment = pytest.importorskip("ultralytics.data.augment")
    ops, nms = pytest.importorskip("ultralytics.utils.ops"), pytest.importorskip("ultralytics.utils.nms")
    rng = np.random.default_rng(seed)
    height, width = rng.integers(20, 900, 2).tolist()
    frame = rng.integers(0, 256, (height, width, 3)).astype(np.uint8)
    boxed, _ = letterbox(frame, (SIDE, SIDE))
    np.testing.assert_array_equal(boxed, augment.LetterBox((SIDE, SIDE), auto=False)(image=frame))
    scores = rng.random((CELLS, 3)).astype(np.float32) ** 2
    output = np.concatenate([random_boxes(rng, CELLS), scores], axis=1).T[None].copy()
    path = constant_network(tmp_path / "a.onnx", {"output0": output}, {"names": str(COCO)})
    found, classes = OnnxDetector(path, [0, 2], 0.1, 0.6).detect(frame)
    (theirs,) = nms.non_max_suppression(torch.from_numpy(output), 0.1, 0.6, classes=[0, 2], nc=3)
    corners = ops.scale_boxes((SIDE, SIDE), theirs[:, :4].clone(), (height, width)).numpy()
    assert len(found.boxes) == len(corners) > 10
    ours = np.concatenate([found.boxes[:, :2], found.boxes[:, :2] + found.boxes[:, 2:]], axis=1)
    np.testing.assert_allclose(ours, corners, atol=2e-4)
    np.testing.assert_allclose(found.confidences, theirs[:, 4].numpy(), atol=1e-7)
    assert classes.tolist() == theirs[:, 5].int().tolist()
