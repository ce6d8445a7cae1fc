"""Cards that a loader must refuse, by name: the change of a valid card and the message that refuses it."""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import Any


def with_encoding(**encoding: Any) -> Callable[[dict[str, Any]], Any]:
    return lambda card: card | {"encoding": {"kind": "servo", **encoding}}


def with_fields(**fields: Any) -> Callable[[dict[str, Any]], Any]:
    return lambda card: card | fields


def with_text(old: str, new: str) -> Callable[[dict[str, Any]], bytes]:
    return lambda card: json.dumps(card).replace(old, new).encode()


CARDS: dict[str, tuple[Callable[[dict[str, Any]], Any], str]] = {
    "code as residual": (with_encoding(residual="evil:make"), "encoding.residual must be the name"),
    "code as follower": (with_encoding(follower="evil:make"), "encoding.follower must be the name"),
    "code as servo": (with_encoding(kind="marker", image_size=96, servo="evil:make"), "encoding.servo must be the n"),
    "code as law": (with_encoding(kind="jacobian", law="evil:make"), "encoding.law must be one of"),
    "code as eyes": (with_encoding(eyes="evil:make"), "encoding.eyes must be the name"),
    "code as environment": (with_fields(env_id="evil:Arm-v0"), "env_id must be"),
    "code as kind": (with_encoding(kind="evil:make"), "encoding.kind must be one of"),
    "a path as residual": (with_encoding(residual="agent.json"), "encoding.residual must be the name"),
    "a path as eyes": (with_encoding(eyes="../agent"), "encoding.eyes must be the name"),
    "an absolute path as eyes": (with_encoding(eyes="/etc/passwd"), "encoding.eyes must be the name"),
    "itself as eyes": (with_encoding(eyes="agent"), "encoding with eyes needs the observations image"),
    "eyes behind a follower": (with_encoding(eyes="agent", follower="phd-servo"), "not have both follower and eyes"),
    "itself as servo": (with_encoding(kind="marker", image_size=96, servo="agent.json"), "encoding.servo must be"),
    "an agent that sees the truth": (with_encoding(residual="oracle"), "encoding.residual must be the name"),
    "a learned agent as residual": (with_encoding(residual="ppo"), "encoding.residual must be the name"),
    "10^8 observations back": (with_encoding(lags=[10**8]), r"encoding.lags\[0\] must be a whole number in 1 to 1000"),
    "10^5 lags": (with_encoding(lags=list(range(1, 10**5))), "encoding.lags must be a list of 0 to 32"),
    "lags in any order": (with_encoding(lags=[3, 1]), "encoding.lags must be .*ascending"),
    "10^9 frames": (with_encoding(frames=10**9), "encoding.frames must be a whole number in 1 to 64"),
    "10^6 pixels": (with_encoding(kind="marker", image_size=10**6, servo="kf"), "encoding.image_size"),
    "10^9 neighbors": (lambda card: card | {"encoding": {"kind": "set", "neighbors": 10**9}}, "encoding.neighbors"),
    "10^12 numbers of memory": (with_fields(memory=10**12), "memory must be a whole number in 0 to 65536"),
    "true as a number": (with_fields(memory=True), "memory must be a whole number"),
    "10^6 levels": (with_fields(levels=[1] * 10**5), "levels must be a list of 0 to 100"),
    "not a number": (with_text('"lags": [1]', '"ages": [NaN]'), "NaN is not a number"),
    "infinity": (with_text('"lags": [1]', '"ages": [-Infinity]'), "-Infinity is not a number"),
    "10^400": (with_text('"lags": [1]', '"ages": [1e400]'), "too large"),
    "10^400 in digits": (with_text('"lags": [1]', f'"lags": [1{"0" * 400}]'), "too large"),
    "10^6 digits": (with_text('"lags": [1]', f'"lags": [{"9" * 10**6}]'), "too large"),
    "a key twice": (with_text('"lags": [1]', '"residual": "kf", "residual": "evil:make"'), "'residual' appears twice"),
    "10^5 levels of nesting": (with_text('"lags": [1]', f'"lags": {"[" * 10**5}'), "nested deeper than 32"),
    "forty levels of nesting": (with_text('"lags": [1]', f'"lags": {"[" * 40}{"]" * 40}'), "nested deeper than 32"),
    "half a surrogate pair": (with_text("linear", "\\ud800"), "surrogates"),
    "not UTF-8": (lambda card: json.dumps(card).encode().replace(b"linear", b"line\xff"), "agent.json is not valid JS"),
    "3 MB": (with_fields(training={"notes": "x" * 3_000_000}), "more than 2000000 bytes"),
    "a list as kind": (with_encoding(kind=["servo"]), "encoding.kind must be one of"),
    "a list as encoding": (with_fields(encoding=["servo"]), "encoding must be a mapping"),
    "a misspelled field": (with_encoding(lag=[1]), "encoding.lag is not a known field; did you mean 'lags'"),
    "a field of Python": (with_fields(__class__="evil"), "__class__ is not a known field"),
    "terminal commands": (with_fields(summary="\x1b]0;evil\x07"), "summary must be a printable text"),
    "a network above it": (with_fields(network="../agent.onnx"), "network must be the name"),
    "a network anywhere": (with_fields(network="/dev/zero.onnx"), "network must be the name"),
    "a network that is no name": (with_fields(network="agent\0.onnx"), "network must be the name"),
    "another digest": (with_fields(sha256="0" * 64), "sha256 is another one"),
    "no digest": (lambda card: {name: card[name] for name in card if name != "sha256"}, "sha256 is missing"),
    "another version": (with_fields(format_version=True), "format version True"),
    "arguments that are no names": (with_fields(env_kwargs={"a.b": 1}), "env_kwargs"),
}  # fmt: skip
