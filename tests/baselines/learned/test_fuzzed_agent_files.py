"""Damaged agents' files: whatever a file holds, loading it gives an agent or an `AgentFileError`, within 5 s.

`SERVOTRACK_FUZZ` sets the number of files, 100,000 by default. The file is also the program that the test starts:
`python test_fuzzed_agent_files.py FOLDER FIRST COUNT` writes the number that it is at into `FOLDER/at`.
"""

from __future__ import annotations

import json
import os
import random
import signal
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from servotrack.baselines.agents.learned.card import AgentFileError, digest, load_card
from servotrack.baselines.agents.learned.network import NetworkSession
from servotrack.baselines.agents.learned.onnx_file.check import OPERATORS
from servotrack.baselines.agents.learned.onnx_file.reader import TYPES
from servotrack.baselines.agents.learned.shipped import SHIPPED, shipped_cards

onnx = pytest.importorskip("onnx")

COUNT = int(os.environ.get("SERVOTRACK_FUZZ", "100000"))
SECONDS = 5
PER_PROCESS = 2500
NUMBERS = (0, 1, -1, 2, 3, 7, 64, 255, 256, 1000, 65_536, 2**31 - 1, -(2**31), 2**40, 2**62, 2**63 - 1, -(2**63))
PIECES = (
    b"\x00", b"\xff", b"\x80", b"\x0a", b"\x0b", b"Loop", b"../", b"evil:make", b"null", b"true", b"NaN", b"1e999",
    b"[", b"{", b'"', b",", b"-1", b"\\ud800", b"9" * 40, b"[" * 200,
)  # fmt: skip


def damaged_bytes(content: bytes, rng: random.Random) -> bytes:
    """Flipped, cut, doubled and inserted bytes."""
    found = bytearray(content)
    for _ in range(rng.choice((1, 1, 2, 3, 8, 40))):
        # Most of a network is weights; what describes them is at both ends.
        ends = rng.random() < 0.7
        reach = min(len(found), 3000) if ends else len(found)
        at = rng.randrange(reach + 1)
        at = len(found) - at if ends and rng.random() < 0.5 else at
        kind = rng.randrange(5)
        if kind == 0 and at < len(found):
            found[at] ^= 1 << rng.randrange(8)
        elif kind == 1 and at < len(found):
            found[at] = rng.randrange(256)
        elif kind == 2:
            del found[at : at + rng.choice((1, 2, 4, 100))]
        elif kind == 3:
            found[at:at] = rng.choice(PIECES)
        else:
            start = rng.randrange(len(found) + 1)
            found[at:at] = found[start : start + rng.choice((1, 4, 30, 300))]
    return bytes(found)


def damaged_network(content: bytes, rng: random.Random) -> bytes:
    """A network in which fields are exchanged, so that the file is well formed and its meaning is not."""
    model = onnx.load_model_from_string(content)
    graph = model.graph
    names = [name for node in graph.node for name in node.output] + [value.name for value in graph.initializer]
    for _ in range(rng.choice((1, 1, 1, 2, 3, 6))):
        node, kind = rng.choice(graph.node), rng.randrange(11)
        if kind == 0:
            node.op_type = rng.choice(sorted(OPERATORS))
        elif kind == 1 and node.input:
            node.input[rng.randrange(len(node.input))] = rng.choice([*names, ""])
        elif kind == 2 and node.attribute:
            _damage_attribute(rng.choice(node.attribute), rng)
        elif kind == 3 and node.input:
            del node.input[rng.randrange(len(node.input))]
        elif kind == 4:
            node.input.append(rng.choice(names))
        elif kind == 5 and graph.initializer:
            _damage_tensor(rng.choice(graph.initializer), rng)
        elif kind == 6:
            graph.node.remove(node)
            graph.node.insert(rng.randrange(len(graph.node) + 1), node)
        elif kind == 7 and node.attribute:
            rng.choice(graph.node).attribute.append(rng.choice(node.attribute))
        elif kind == 8:
            port = rng.choice([*graph.input, *graph.output]).type.tensor_type
            if port.shape.dim:
                rng.choice(port.shape.dim).dim_value = rng.choice(NUMBERS)
            port.elem_type = rng.choice([port.elem_type, *TYPES, 11])
        elif kind == 9:
            node.output[rng.randrange(len(node.output))] = rng.choice([*names, "", "action", "new"])
        else:
            model.opset_import[0].version = rng.choice((*range(11, 26), 999))
    return bytes(model.SerializeToString())


def _damage_attribute(attribute: Any, rng: random.Random) -> None:
    if attribute.HasField("t"):
        _damage_tensor(attribute.t, rng)
    elif attribute.ints:
        attribute.ints[rng.randrange(len(attribute.ints))] = rng.choice(NUMBERS)
    elif attribute.HasField("f"):
        attribute.f = rng.choice((0.0, -1.0, float("nan"), float("inf"), 1e38))
    else:
        attribute.i = rng.choice(NUMBERS)


def _damage_tensor(tensor: Any, rng: random.Random) -> None:
    whole = tensor.data_type == 7
    if whole and rng.random() < 0.8:
        # A tensor that was floats before an earlier damage does not fill its shape any more.
        stored = tensor.raw_data[: len(tensor.raw_data) // 8 * 8]
        values = np.frombuffer(stored, "<i8").copy() if stored else np.array(tensor.int64_data, np.int64)
        if len(values):
            values[rng.randrange(len(values))] = rng.choice(NUMBERS)
            tensor.raw_data = values.tobytes()
    elif tensor.dims and rng.random() < 0.6:
        # Weights of another shape with as many elements pass the reader and have to be found by the operators.
        order = rng.sample(list(tensor.dims), len(tensor.dims))
        if rng.random() < 0.5:
            order[rng.randrange(len(order))] = rng.choice(NUMBERS)
        tensor.dims[:] = order
    else:
        tensor.data_type = rng.choice((*TYPES, 8, 11))


def one(number: int, folder: Path, networks: dict[Path, bytes]) -> None:
    """Damage the file of one number and load it; a wrong exception passes through."""
    rng = random.Random(number)
    path = rng.choice(list(networks))
    card = SHIPPED / f"{path.stem}.json"
    if number % 3 == 0:
        (folder / "damaged.json").write_bytes(damaged_bytes(card.read_bytes(), rng))
        try:
            load_card(folder / "damaged.json")
        except AgentFileError as error:
            assert "damaged.json" in str(error) and len(str(error)) < 1000
        return
    damage = damaged_network if number % 3 == 1 else damaged_bytes
    content = damage(networks[path], rng)
    document = json.loads(card.read_bytes())
    document["sha256"] = digest(content)
    (folder / "damaged.json").write_text(json.dumps(document))
    (folder / "damaged.onnx").write_bytes(content)
    try:
        session = NetworkSession(folder / "damaged.onnx", load_card(folder / "damaged.json"))
        for rows in (1, 3):
            inputs = {
                name: np.full((rows, *row.shape), 0.5, TYPES[row.kind]) for name, row in session.form.inputs.items()
            }
            session.run(list(session.form.outputs), inputs)
    except AgentFileError as error:
        assert "damaged.onnx" in str(error) and len(str(error)) < 1500


def run(folder: Path, first: int, count: int) -> None:
    """Load the files of several numbers; an alarm ends the process at a file that takes too long."""
    networks = {path: path.with_suffix(".onnx").read_bytes() for path in shipped_cards()}
    for number in range(first, first + count):
        (folder / "at").write_text(str(number))
        signal.alarm(SECONDS)
        one(number, folder, networks)
    signal.alarm(0)


@pytest.mark.slow
def test_damaged_files_are_loaded_or_refused() -> None:
    if not hasattr(signal, "alarm"):
        pytest.skip("needs alarms of POSIX")
    bad = []
    with tempfile.TemporaryDirectory() as name:
        for first in range(0, COUNT, PER_PROCESS):
            command = [sys.executable, __file__, name, str(first), str(min(PER_PROCESS, COUNT - first))]
            done = subprocess.run(command, capture_output=True, text=True, check=False)
            if done.returncode:
                last = (done.stderr.splitlines() or [f"ended by signal {-done.returncode}"])[-1]
                bad.append(f"file {(Path(name) / 'at').read_text()}: {last}")
    assert not bad, "\n".join(bad)


if __name__ == "__main__":
    run(Path(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3]))
