"""Allowed operators: each has an example whose inferred shape is onnxruntime's, and torch exports no others."""

from __future__ import annotations

import itertools
from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime
import pytest

from servotrack.baselines.agents.learned.onnx_file.check import OPERATORS, check_network
from servotrack.baselines.agents.learned.onnx_file.reader import FLOAT, TYPES

onnx = pytest.importorskip("onnx")

SIZE = 12


def node(operator: str, inputs: str, outputs: str = "action", **attributes: Any) -> Any:
    return onnx.helper.make_node(
        operator, [x if x != "-" else "" for x in inputs.split()], outputs.split(), **attributes
    )


def whole(*numbers: int) -> Any:
    return np.array(numbers, np.int64)


def filled(*shape: int) -> Any:
    """Positive numbers that differ."""
    return (0.1 + np.arange(np.prod(shape, dtype=int)) % 7).astype(np.float32).reshape(shape)


AS_IMAGE = node("Reshape", "observation image", "u")
IMAGE = {"image": whole(-1, 1, 3, 4)}
AS_SETS = node("Reshape", "observation sets", "u")
SETS = {"sets": whole(-1, 3, 4)}
AS_STEP = node("Unsqueeze", "observation zero", "u")
STEP = {"zero": whole(0)}
TO_ROWS = node("Squeeze", "v zero")
GREATER = node("Greater", "observation one", "g")

EXAMPLES: dict[str, tuple[list[Any], dict[str, Any], tuple[int, ...]]] = {
    **{
        name: ([node(name, "observation")], {}, (SIZE,))
        for name in ("Abs", "Celu", "Elu", "Erf", "Exp", "Gelu", "HardSwish", "Identity", "LeakyRelu", "Log", "Neg",
                     "Relu", "Selu", "Sigmoid", "Softmax", "Softplus", "Sqrt", "Tanh")
    },
    **{
        name: ([node(name, "observation w")], {"w": filled(1, SIZE)}, (SIZE,))
        for name in ("Add", "Sub", "Mul", "Div", "Pow", "Min", "Max", "Equal", "Greater", "GreaterOrEqual", "Less",
                     "LessOrEqual")
    },
    **{name: ([GREATER, node(name, "g g")], {"one": filled(1)}, (SIZE,)) for name in ("And", "Or")},
    **{
        name: ([AS_SETS, node(name, "u axis", keepdims=0)], {**SETS, "axis": whole(1)}, (4,))
        for name in ("ReduceMax", "ReduceMean", "ReduceMin", "ReduceSum")
    },
    "Not": ([GREATER, node("Not", "g")], {"one": filled(1)}, (SIZE,)),
    "Where": ([GREATER, node("Where", "g observation one")], {"one": filled(1)}, (SIZE,)),
    "Cast": ([node("Cast", "observation", to=7)], {}, (SIZE,)),
    "Clip": ([node("Clip", "observation - high")], {"high": np.float32(0.5)}, (SIZE,)),
    "Mod": ([node("Mod", "seven four", "k"), node("Gather", "observation k", axis=1)],
            {"seven": whole(7), "four": whole(4)}, (1,)),
    "Concat": ([node("Concat", "observation observation", axis=-1)], {}, (2 * SIZE,)),
    "Constant": ([node("Constant", "", "c", value=onnx.numpy_helper.from_array(filled(1))),
                  node("Add", "observation c")], {}, (SIZE,)),
    "ConstantOfShape": ([node("Shape", "observation", "s"), node("ConstantOfShape", "s")], {}, (SIZE,)),
    "Expand": ([AS_SETS, node("Slice", "u zero one axis", "v"), node("Shape", "u", "s"), node("Expand", "v s")],
               {**SETS, "zero": whole(0), "one": whole(1), "axis": whole(1)}, (3, 4)),
    "Flatten": ([AS_SETS, node("Flatten", "u")], SETS, (SIZE,)),
    "Gather": ([node("Gather", "observation i", axis=1)], {"i": whole(0, -1, 3)}, (3,)),
    "Reshape": ([node("Reshape", "observation s")], {"s": whole(0, 2, -1)}, (2, 6)),
    "Shape": ([node("Shape", "observation", "s", start=-1), node("Concat", "all s", "t", axis=0),
               node("Reshape", "observation t")], {"all": whole(-1)}, (SIZE,)),
    "Slice": ([node("Slice", "observation start end axis step")],
              {"start": whole(-7), "end": whole(2**63 - 1), "axis": whole(1), "step": whole(2)}, (4,)),
    "Split": ([node("Split", "observation s", "a action b", axis=1)], {"s": whole(3, 4, 5)}, (4,)),
    "Squeeze": ([AS_STEP, node("Squeeze", "u zero")], STEP, (SIZE,)),
    "Transpose": ([AS_SETS, node("Transpose", "u", perm=[0, 2, 1])], SETS, (4, 3)),
    "Unsqueeze": ([node("Unsqueeze", "observation i")], {"i": whole(1, -1)}, (1, SIZE, 1)),
    "Gemm": ([node("Gemm", "observation w b", transB=1, alpha=0.5)], {"w": filled(5, SIZE), "b": filled(5)}, (5,)),
    "MatMul": ([AS_SETS, node("MatMul", "u w")], {**SETS, "w": filled(4, 2)}, (3, 2)),
    "Conv": ([AS_IMAGE, node("Conv", "u w b", pads=[1, 0, 2, 1], strides=[2, 1], dilations=[1, 2])],
             {**IMAGE, "w": filled(5, 1, 2, 2), "b": filled(5)}, (5, 3, 3)),
    "MaxPool": ([AS_IMAGE, node("MaxPool", "u", kernel_shape=[2, 3], strides=[1, 2], pads=[0, 1, 1, 1])], IMAGE,
                (1, 3, 2)),
    "AveragePool": ([AS_IMAGE, node("AveragePool", "u", kernel_shape=[2, 2], auto_pad="SAME_UPPER")], IMAGE, (1, 3, 4)),
    "GlobalAveragePool": ([AS_IMAGE, node("GlobalAveragePool", "u")], IMAGE, (1, 1, 1)),
    "BatchNormalization": ([AS_SETS, node("BatchNormalization", "u a a a a")], {**SETS, "a": filled(3)}, (3, 4)),
    "LayerNormalization": ([AS_SETS, node("LayerNormalization", "u a", axis=-1)], {**SETS, "a": filled(4)}, (3, 4)),
    "GRU": ([AS_STEP, node("GRU", "u w r", "y v", hidden_size=2), TO_ROWS],
            {**STEP, "w": filled(1, 6, SIZE), "r": filled(1, 6, 2)}, (2,)),
    "LSTM": ([AS_STEP, node("LSTM", "u w r b", "y h v", hidden_size=2), TO_ROWS],
             {**STEP, "w": filled(1, 8, SIZE), "r": filled(1, 8, 2), "b": filled(1, 16)}, (2,)),
}  # fmt: skip
KINDS = {
    **dict.fromkeys(("Equal", "Greater", "GreaterOrEqual", "Less", "LessOrEqual", "And", "Or", "Not"), 9),
    "Cast": 7,
}


def session(content: bytes) -> onnxruntime.InferenceSession:
    return onnxruntime.InferenceSession(content, providers=["CPUExecutionProvider"])


def test_every_operator_has_an_example() -> None:
    assert set(EXAMPLES) == set(OPERATORS)


@pytest.mark.parametrize("name", EXAMPLES)
def test_shapes_are_those_of_onnxruntime(name: str) -> None:
    nodes, stored, row = EXAMPLES[name]
    kind = KINDS.get(name, FLOAT)
    graph = onnx.helper.make_graph(
        nodes,
        name,
        [onnx.helper.make_tensor_value_info("observation", FLOAT, ["n", SIZE])],
        [onnx.helper.make_tensor_value_info("action", kind, ["n", *row])],
        [onnx.numpy_helper.from_array(np.asarray(array), key) for key, array in stored.items()],
    )
    opsets = [onnx.helper.make_opsetid("", 22)]
    content = onnx.helper.make_model(graph, opset_imports=opsets, ir_version=9).SerializeToString()
    checked = check_network(content)
    assert checked.outputs["action"] == (kind, row)
    for rows in (1, 3):
        (answer,) = session(content).run(None, {"observation": filled(rows, SIZE)})
        assert answer.shape == (rows, *row) and answer.dtype == TYPES[kind]


def test_what_torch_exports_is_allowed(tmp_path: Path) -> None:
    """Multilayer perceptrons, convolutional and recurrent networks, attention and sums over sets."""
    torch = pytest.importorskip("torch")
    pytest.importorskip("stable_baselines3")
    from torch import nn

    from servotrack.baselines.training.export import Exportable, export, exportable_policy

    class Recurrent(nn.Module):
        def __init__(self, cell: Any, layers: int) -> None:
            super().__init__()
            self.states, self.layers = 2 if cell is nn.LSTM else 1, layers
            self.cell, self.head = cell(SIZE, 8, layers), nn.Linear(8, 2)

        def forward(self, rows: Any, memory: Any) -> Any:
            states = memory.reshape(-1, self.states, self.layers, 8).permute(1, 2, 0, 3).contiguous()
            out, states = self.cell(rows[None], tuple(states) if self.states == 2 else states[0])
            stacked = torch.stack(list(states)) if self.states == 2 else states[None]
            return self.head(out[0]), stacked.permute(2, 0, 1, 3).reshape(-1, 8 * self.layers * self.states)

    class Attention(nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.entry, self.head = nn.Linear(4, 8), nn.Linear(8, 2)
            self.layer = nn.TransformerEncoderLayer(8, 2, 16, batch_first=True)

        def forward(self, rows: Any) -> Any:
            return self.head(self.layer(self.entry(rows.view(-1, 3, 4))).amax(1))

    class Sum(nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.entry, self.head = nn.Linear(4, 8), nn.Linear(8, 2)

        def forward(self, rows: Any) -> Any:
            members = rows.reshape(rows.shape[0], 3, 4)
            there = (members[..., :1] > 0.5).float()
            return self.head((torch.relu(self.entry(members)) * there).sum(1) / there.sum(1).clamp(min=1.0))

    activations = (nn.ReLU, nn.Tanh, nn.ELU, nn.SiLU, nn.GELU, nn.LeakyReLU, nn.SELU, nn.Mish, nn.Hardtanh, nn.CELU)
    layered = [nn.Sequential(nn.Linear(SIZE, 8), act(), nn.LayerNorm(8), nn.Linear(8, 2)) for act in activations]
    images = nn.Sequential(
        nn.Conv2d(3, 4, 8, 4), nn.BatchNorm2d(4), nn.ReLU(), nn.MaxPool2d(2), nn.Conv2d(4, 4, 3, padding="same"),
        nn.AvgPool2d(2), nn.Flatten(), nn.LazyLinear(2),
    )  # fmt: skip
    images(torch.zeros(1, 3, 84, 84))
    subjects = [exportable_policy(module, SIZE) for module in (*layered, Attention(), Sum())]
    subjects.append(Exportable(images, {"observation": torch.zeros(2, 3, 84, 84)}, ("action",)))
    for cell, layers in itertools.product((nn.GRU, nn.LSTM), (1, 2)):
        subjects.append(exportable_policy(Recurrent(cell, layers), SIZE, 8 * layers * (2 if cell is nn.LSTM else 1)))
    for subject in subjects:
        subject.network.eval()
        content = export(subject, tmp_path / "network.onnx")
        assert check_network(content).outputs["action"] == (FLOAT, (2,))
        rows = {name: filled(3, *example.shape[1:]) for name, example in subject.inputs.items()}
        with torch.no_grad():
            expected = subject.network(*map(torch.tensor, rows.values()))
        answer = session(content).run(["action"], rows)[0]
        expected = expected[0] if isinstance(expected, tuple) else expected
        assert np.abs(answer - expected.numpy()).max() < 1e-4
