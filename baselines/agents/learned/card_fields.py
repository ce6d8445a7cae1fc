"""Fields of a learned agent's card, and their bounds. Cards may come from strangers: nothing in one is code or a path.

Agents are named from fixed tables. `module:callable` and paths are for users to type; in files they are refused.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any, get_args

from servotrack.baselines.agents.follow.cards import CARDS as FOLLOW_CARDS
from servotrack.baselines.agents.learned.field_rules import Choice, Many, Number, Plain, Record, Rule, Text, Whole
from servotrack.baselines.agents.protocol import AgentCard, Information
from servotrack.baselines.agents.servo.cards import CARDS as SERVO_CARDS
from servotrack.baselines.agents.servo.cards import LAWS


def _names(cards: Iterable[AgentCard]) -> tuple[str, ...]:
    """Return the names of agents that do not see the truth, with every law that can be chosen."""
    honest = [card for card in cards if not card.requires]
    return (*(card.name for card in honest), *(f"{card.name}+{law}" for card in honest if card.laws for law in LAWS))


_SERVO = Choice(_names(SERVO_CARDS), "the name of a classical servo, as `servotrack agents` lists them")
_FOLLOWER = Choice(_names(FOLLOW_CARDS), "the name of an agent that follows one person of many")
_EYES = Text(200, r"\w[\w.,=+-]*", "the name of a marker network's card without folder and suffix")
_LAGS = Many(Whole(1, 1000), 0, 32, ascending=True)
_AGES = Many(Number(0.0, 6.0), 1, 16)
_KINDS = ("flat", "raw", "servo", "steering", "marker", "jacobian", "set")
_OF_FEATURES: Mapping[str, Rule] = {
    "kind": Choice(_KINDS), "frames": Whole(1, 64), "residual": _SERVO, "identifier": _SERVO, "eyes": _EYES,
    "follower": _FOLLOWER,
}  # fmt: skip

ENCODINGS: Mapping[str, Record] = {
    "flat": Record(_OF_FEATURES),
    "raw": Record(_OF_FEATURES),
    "servo": Record({**_OF_FEATURES, "lags": _LAGS, "ages": _AGES}),
    "steering": Record({"kind": Choice(_KINDS), "frames": Whole(1, 64)}),
    "marker": Record(
        {"kind": Choice(_KINDS), "image_size": Whole(8, 1024), "servo": _SERVO}, required=("image_size", "servo")
    ),
    "jacobian": Record({"kind": Choice(_KINDS), "law": Choice(LAWS), "lags": _LAGS, "ages": _AGES}),
    "set": Record(
        {
            "kind": Choice(_KINDS), "scans": Whole(1, 100), "asked": Whole(1, 100), "neighbors": Whole(1, 200),
            "merge": Number(0.0, 1e4, open=True), "report": Number(0.0, 1.0, open=True),
        }
    ),
}  # fmt: skip
"""Conditions on the settings of an encoding by its kind."""


class _Encoding:
    """Settings of an encoding, whose fields depend on its kind."""

    @property
    def words(self) -> str:
        """The condition in words."""
        return f"a mapping with a kind, {', '.join(ENCODINGS)}, and the settings of that kind"

    def check(self, value: Any, where: str) -> None:
        """Raise ValueError for another value."""
        if not isinstance(value, Mapping):
            raise ValueError(f"{where} must be {self.words}, got {type(value).__name__}")
        kind = value.get("kind", "flat")
        Choice(_KINDS).check(kind, f"{where}.kind")
        ENCODINGS[kind].check(value, where)
        if {"follower", "eyes"} <= set(value):
            raise ValueError(f"{where} must not have both follower and eyes; leave one out")


CARD = Record(
    {
        "name": Text(100, r"[^/\\:]+", "a printable name of 1 to 100 characters without / \\ :"),
        "summary": Text(2000),
        "env_id": Text(200, r"([\w.-]+/)?[\w.-]+", "an id of Gymnasium without a module, at most 200 characters"),
        "env_kwargs": Plain(1000, Text(100, r"[A-Za-z_]\w*", "an identifier of at most 100 characters")),
        "encoding": _Encoding(),
        "network": Text(
            200, r"[^/\\:]+\.onnx", "the name of an .onnx file in the card's own folder, at most 200 characters"
        ),
        "sha256": Text(64, "[0-9a-f]{64}", "64 hexadecimal digits"),
        "memory": Whole(0, 65_536),
        "information": Choice(get_args(Information)),
        "levels": Many(Whole(0, 1000), 0, 100),
        "steps": Whole(0, 10**15),
        "training": Plain(100_000, Text(100)),
    },
    required=("name", "summary", "env_id", "env_kwargs", "encoding", "network", "sha256"),
)
"""Conditions on the fields of a card, `format` and `format_version` left out."""


def check_encoding(settings: Any) -> None:
    """Check the settings of an encoding, from a card or from a file of hyper-parameters.

    Raises:
        ValueError: An unknown kind or field, or a value out of bounds; the message names the field.
    """
    CARD.fields["encoding"].check(settings, "encoding")


def check_card(fields: Mapping[str, Any]) -> None:
    """Check the fields of a card.

    Raises:
        ValueError: A missing or unknown field, or a value out of bounds; the message names the field.
    """
    CARD.check(fields, "")
