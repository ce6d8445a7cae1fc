"""Files of learned agents: what they say, what is refused, and that nothing in them can run code."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

import servotrack  # noqa: F401
from servotrack.baselines.agents.learned.agent import create_learned_agent
from servotrack.baselines.agents.learned.card import AgentFileError, LearnedCard, digest, load_card
from servotrack.baselines.agents.learned.card_fields import CARD, ENCODINGS
from servotrack.baselines.agents.learned.marker_network import keep_marker_network, open_marker_network
from servotrack.baselines.agents.learned.network import LARGEST_BATCH_MEMORY, LARGEST_NETWORK
from servotrack.baselines.agents.learned.onnx_file import check, reader
from servotrack.baselines.agents.learned.onnx_file.check import OPERATORS
from servotrack.baselines.agents.learned.servo_encoding import ServoEncoding
from servotrack.baselines.agents.learned.set_prediction import SetWindow
from servotrack.baselines.agents.learned.shipped import SHIPPED
from servotrack.baselines.agents.registry import agent_card, create_agent
from servotrack.baselines.training.settings import TrainingSettings

onnx = pytest.importorskip("onnx")

ROWS = ServoEncoding().size


def network(rows: int = ROWS, actions: int = 2, domain: str = "", name: str = "observation", dtype: int = 1) -> bytes:
    """A linear network."""
    helper = onnx.helper
    weights = onnx.numpy_helper.from_array(np.full((rows, actions), 0.01, np.float32), "weights")
    graph = helper.make_graph(
        [helper.make_node("MatMul", [name, "weights"], ["action"], domain=domain)],
        "linear",
        [helper.make_tensor_value_info(name, dtype, ["n", rows])],
        [helper.make_tensor_value_info("action", 1, ["n", actions])],
        [weights],
    )
    opsets = [helper.make_opsetid("", 17), *([helper.make_opsetid(domain, 1)] if domain else [])]
    return onnx.helper.make_model(graph, opset_imports=opsets, ir_version=9).SerializeToString()  # type: ignore[no-any-return]


def write(folder: Path, content: bytes, **fields: Any) -> Path:
    """An agent's two files."""
    card = LearnedCard(
        **{
            "name": "linear",
            "summary": "a linear network",
            "env_id": "UncalibServo-v0",
            "env_kwargs": {"level": 3},
            "encoding": {"kind": "servo"},
            "network": "linear.onnx",
            "sha256": digest(content),
            **fields,
        }
    )
    (folder / "linear.onnx").write_bytes(content)
    (folder / "linear.json").write_text(card.as_json())
    return folder / "linear.json"


@pytest.fixture()
def env() -> Any:
    return gym.make("UncalibServo-v0", level=3)


def test_a_file_is_an_agent_s_name(tmp_path: Path, env: Any) -> None:
    path = write(tmp_path, network(), steps=7)
    for name in (str(path), str(path.with_suffix(".onnx"))):
        card = agent_card(name)
        assert (card.information, card.tuning_steps, card.summary) == ("prior", 7, "a linear network")
        observation, _ = env.reset(seed=100_000)
        action, _ = create_agent(card, env).predict(observation)
        assert action.shape == (2,) and action.dtype == np.float32 and env.action_space.contains(action)


def test_a_card_says_all_again(tmp_path: Path) -> None:
    path = write(tmp_path, network(), training={"seed": 3, "curve": [{"steps": 1}]})
    card = load_card(path)
    assert card.training == {"seed": 3, "curve": [{"steps": 1}]} and card.environment == "UncalibServo-v0,level=3"
    assert load_card(path.with_suffix(".onnx")) == card


BAD_NETWORKS: dict[str, tuple[Callable[[], bytes], str]] = {
    "text": (lambda: b"import os; os.system('true')", "not ONNX"),
    "empty": (lambda: b"", "ir_version must lie in"),
    "truncated": (lambda: network()[:200], "truncated"),
    "foreign operator": (lambda: network(domain="org.example"), "org.example"),
    "too large": (lambda: bytes(LARGEST_NETWORK + 1), f"more than {LARGEST_NETWORK} bytes"),
    "other input": (lambda: network(name="pixels"), "observation"),
    "other rows": (lambda: network(rows=5), "reads rows of 5"),
    "other actions": (lambda: network(actions=3), "gives 3 numbers"),
    "double precision": (lambda: network(dtype=11), "type float32"),
}


@pytest.mark.parametrize("kind", BAD_NETWORKS)
def test_networks_that_cannot_be_used_are_refused_with_a_reason(kind: str, tmp_path: Path, env: Any) -> None:
    make, message = BAD_NETWORKS[kind]
    path = write(tmp_path, make())
    with pytest.raises(AgentFileError, match=message):
        create_learned_agent(env, str(path))


def test_a_network_that_refers_to_other_files_is_refused(tmp_path: Path, env: Any) -> None:
    model = onnx.load_model_from_string(network())
    onnx.save_model(
        model, str(tmp_path / "linear.onnx"), save_as_external_data=True, location="weights.bin", size_threshold=0
    )
    path = write(tmp_path, (tmp_path / "linear.onnx").read_bytes())
    with pytest.raises(AgentFileError, match="external_data, which is not allowed"):
        create_learned_agent(env, str(path))


def test_a_network_that_is_not_the_card_s_is_refused(tmp_path: Path, env: Any) -> None:
    path = write(tmp_path, network())
    (tmp_path / "linear.onnx").write_bytes(network() + b"\0")
    with pytest.raises(AgentFileError, match="not the file that its card describes"):
        create_learned_agent(env, str(path))
    (tmp_path / "linear.onnx").unlink()
    with pytest.raises(AgentFileError, match="beside its card"):
        create_learned_agent(env, str(path))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"format": "pickle"}, "no card of a learned agent"),
        ({"format_version": 9}, "version 9"),
        ({"encoding": None}, "encoding must be a mapping"),
        ({"steps": -1}, "steps must be a whole number in 0 to"),
        ({"steps": True}, "steps must be a whole number"),
        ({"memory": 1.5}, "memory must be a whole number"),
        ({"information": "everything"}, "information must be one of"),
        ({"network": "../linear.onnx"}, "own folder"),
        ({"surprise": 1}, "surprise"),
        ({"memory": 8}, "memory"),
        ({"encoding": {"kind": "wavelets"}}, "encoding.kind must be one of flat, raw, servo"),
        ({"encoding": {"kind": "jacobian"}}, "a Jacobian needs"),
        ({"encoding": {"kind": "jacobian", "law": "bang-bang"}}, "law must be one of"),
        ({"encoding": {"kind": "set"}}, "scene_model` is a SceneModel"),
        ({"encoding": {"kind": "steering"}}, "scene_model` is a SceneModel"),
        ({"encoding": {"kind": "servo", "follower": "phd-servo"}}, "does not fit this environment"),
        ({"levels": ["all"]}, r"levels\[0\] must be a whole number"),
        ({"levels": 3}, "levels must be a list"),
    ],
)
def test_cards_that_cannot_be_used_are_refused_with_a_reason(
    change: dict[str, Any], message: str, tmp_path: Path, env: Any
) -> None:
    path = write(tmp_path, network())
    path.write_text(json.dumps(json.loads(path.read_text()) | change))
    with pytest.raises(AgentFileError, match=message):
        create_learned_agent(env, str(path))


@pytest.mark.parametrize("content", ["", "{", "[]", '"pickle"', "\x80\x04N."])
def test_what_is_no_card_is_refused(content: str, tmp_path: Path) -> None:
    (tmp_path / "linear.json").write_text(content)
    with pytest.raises(AgentFileError):
        load_card(tmp_path / "linear.json")


def test_missing_fields_are_named(tmp_path: Path) -> None:
    path = write(tmp_path, network())
    content = json.loads(path.read_text())
    del content["sha256"]
    path.write_text(json.dumps(content))
    with pytest.raises(AgentFileError, match="sha256"):
        load_card(path)
    with pytest.raises(AgentFileError, match="cannot be read"):
        agent_card(str(tmp_path / "nobody.json"))


def test_an_agent_of_another_world_is_refused(tmp_path: Path) -> None:
    path = write(tmp_path, network())
    with pytest.raises(AgentFileError, match="does not fit this environment"):
        create_learned_agent(gym.make("ClutterTracking-v0"), str(path))
    flat = write(tmp_path, network(), encoding={"kind": "flat"})
    with pytest.raises(AgentFileError, match="trained in UncalibServo-v0"):
        create_learned_agent(gym.make("UncalibServoReach-v0"), str(flat))


def test_a_set_predictor_s_network_has_to_fit_its_window(tmp_path: Path) -> None:
    env = gym.make("ClutterTracking-v0", level=2)
    fields = {"env_id": "ClutterTracking-v0", "env_kwargs": {"level": 2}}
    fits = write(tmp_path, network(SetWindow().size, 5), encoding={"kind": "set"}, **fields)
    observation, _ = env.reset(seed=100_000)
    answer, _ = create_learned_agent(env, str(fits)).predict(observation)
    assert env.action_space.contains(answer)
    with pytest.raises(AgentFileError, match="its window needs"):
        create_learned_agent(env, str(write(tmp_path, network(), encoding={"kind": "set"}, **fields)))
    with pytest.raises(AgentFileError, match="`asked` <= scans"):
        settings = {"kind": "set", "scans": 2}
        create_learned_agent(env, str(write(tmp_path, network(SetWindow().size, 5), encoding=settings, **fields)))


def test_rows_of_a_batch_act_and_forget_alone(tmp_path: Path) -> None:
    path = write(tmp_path, network())
    many = gym.make_vec("UncalibServo-v0", num_envs=3, level=3)
    agent = create_learned_agent(many, str(path))
    observation, _ = many.reset(seed=[100_000, 100_001, 100_002])
    state: Any = None
    for _ in range(5):
        action, state = agent.predict(observation, state)
        observation, *_ = many.step(action)
    resumed, _ = agent.predict(observation, state, np.array([False, True, False]))
    going_on, _ = agent.predict(observation, state)
    anew, _ = agent.predict(observation)
    assert np.array_equal(resumed[[0, 2]], going_on[[0, 2]]) and np.array_equal(resumed[1], anew[1])
    assert not np.array_equal(going_on[1], anew[1])


def test_settings_of_a_training_name_no_code_either() -> None:
    for encoding in ({"kind": "servo", "residual": "evil:make"}, {"kind": "servo", "eyes": "../eyes"}):
        with pytest.raises(ValueError, match=r"encoding\.(residual|eyes) must be the name"):
            TrainingSettings("ppo", "ppo", encoding=encoding)


def test_a_trained_agent_keeps_the_marker_network_that_it_names(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shipped = "UncalibServoPixels-v0-level3-eyes"
    card = json.loads((SHIPPED / f"{shipped}.json").read_text())
    (tmp_path / "mine.json").write_text(json.dumps(card))
    (tmp_path / card["network"]).write_bytes((SHIPPED / card["network"]).read_bytes())
    monkeypatch.chdir(tmp_path)
    folder = tmp_path / "agent"
    keep_marker_network(shipped, folder)
    assert not folder.exists()
    keep_marker_network("mine", folder)
    monkeypatch.chdir("/")
    images = np.zeros((2, 96, 96, 3), np.uint8)
    kept, known = (open_marker_network(name, folder).detect(images) for name in ("mine", shipped))
    assert all(np.array_equal(*pair) for pair in zip(kept, known, strict=True))
    with pytest.raises(AgentFileError, match=r"eyes names 'yours', but .*yours.json are missing"):
        open_marker_network("yours", folder)


def test_learned_agents_refuse_a_clock_that_goes_backwards(tmp_path: Path, env: Any) -> None:
    """In the words of the classical ones, for one environment and for single rows of a batch."""
    path = write(tmp_path, network())
    observation, _ = env.reset(seed=100_000)
    later = {**observation, "time": observation["time"] + 1.0}
    for name in (str(path), "kf"):
        agent: Any = create_agent(agent_card(name), env)
        _, state = agent.predict(later)
        with pytest.raises(ValueError, match=r"time must not go backwards, got 0.0 after 1.0"):
            agent.predict(observation, state)
        agent.predict(observation, state, True)
        both = {key: np.stack([later[key], observation[key]]) for key in observation}
        turned = {key: value[::-1] for key, value in both.items()}
        _, states = agent.predict(both)
        with pytest.raises(ValueError, match="time must not go backwards"):
            agent.predict(turned, states)
        agent.predict(turned, states, np.array([True, False]))
    agent = create_agent(agent_card(str(path)), env)
    with pytest.raises(ValueError, match="observation time must be finite, got inf"):
        agent.predict({**observation, "time": np.array([np.inf])})


def test_the_page_lists_every_field_and_limit() -> None:
    page = (Path(__file__).parents[3] / "docs" / "learned.md").read_text(encoding="utf-8")
    rows = {
        row.split(" | ")[0].lstrip("| "): row.split(" | ")[1].rstrip(" |") for row in page.splitlines() if " | " in row
    }
    for name, rule in CARD.fields.items():
        assert rows[f"`{name}`"] == rule.words
    settings: dict[tuple[str, str], list[str]] = {}
    for kind, record in ENCODINGS.items():
        for name, rule in record.fields.items():
            settings.setdefault((name, rule.words), []).append(kind)
    for (name, words), kinds in settings.items():
        assert name == "kind" or rows[f"`encoding.{name}` ({', '.join(kinds)})"] == words
    assert rows["operators"] == ", ".join(sorted(OPERATORS))
    limits = (
        LARGEST_NETWORK, LARGEST_BATCH_MEMORY, check.MOST_WORK, check.MOST_ROW_MEMORY, check.MOST_FIXED_MEMORY,
        reader.MOST_FIELDS, reader.MOST_NODES, reader.MOST_WEIGHTS, reader.LARGEST_AXIS,
    )  # fmt: skip
    assert not [limit for limit in limits if f"{limit:,}" not in " ".join(rows.values())]
