"""Exact states of environments: dictionaries of arrays from which an environment goes on to the bit.

An episode is drawn from its seed, so a state holds the seeds and what has happened since the reset. The arrays have no
objects in them: `numpy.savez` writes them, and a file of them can be loaded without `pickle`.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, is_dataclass
from typing import Any, Protocol

import numpy as np
from gymnasium.error import ResetNeeded
from numpy.typing import NDArray

from servotrack.estimators.types import Mask

State = dict[str, NDArray[Any]]
"""State of an environment: `format`, `environment`, `configuration`, and arrays with a leading axis of N scenes."""

FORMAT = 1
"""Version of the layout of states."""


class Stateful(Protocol):
    """Part of an environment that changes from step to step."""

    def get_state(self) -> State:
        """Return copies of what `set_state` needs."""

    def set_state(self, state: Mapping[str, NDArray[Any]]) -> None:
        """Go back to a state. Raises a ValueError if it does not fit."""


def taken(owner: Any, names: Iterable[str]) -> State:
    """Return copies of some attributes, keyed by their names without leading underscores."""
    return {name.lstrip("_"): np.array(getattr(owner, name)) for name in names}


def put(owner: Any, names: Iterable[str], state: Mapping[str, NDArray[Any]]) -> None:
    """Write what `taken` returned into the attributes, which must be arrays.

    Raises:
        ValueError: An entry is missing, or has another shape or type.
    """
    for name in names:
        array = getattr(owner, name)
        array[...] = entry(state, name.lstrip("_"), array.shape, array.dtype)


def entry(state: Mapping[str, NDArray[Any]], name: str, shape: tuple[int | None, ...], dtype: Any) -> NDArray[Any]:
    """Return an entry of a state.

    Args:
        state: State or part of one.
        name: Name of the entry.
        shape: Shape of the entry; None for an axis of any length.
        dtype: Type of the entry.

    Raises:
        ValueError: The entry is missing, has another shape or type, or is not finite.
    """
    if name not in state:
        raise ValueError(f"state lacks {name!r}; take it with get_state() of the same environment")
    value = np.asarray(state[name])
    fits = value.ndim == len(shape) and all(
        own in (None, length) for own, length in zip(shape, value.shape, strict=True)
    )
    if not fits or value.dtype != dtype:
        wanted = tuple("any" if length is None else length for length in shape)
        raise ValueError(
            f"state's {name!r} must be {np.dtype(dtype)} of shape {wanted}, got {value.dtype} of shape {value.shape}"
        )
    if value.dtype.kind == "f" and not np.isfinite(value).all():
        raise ValueError(f"state's {name!r} must be finite, got NaN or infinity")
    return value


def part(state: Mapping[str, NDArray[Any]], name: str) -> State:
    """Return the entries whose names begin with `name` and a slash, without both."""
    return {key[len(name) + 1 :]: value for key, value in state.items() if key.startswith(f"{name}/")}


def parts_state(parts: Mapping[str, Stateful]) -> State:
    """Return the states of several parts, each entry's name behind its part's."""
    return {f"{name}/{key}": value for name, piece in parts.items() for key, value in piece.get_state().items()}


def set_parts(
    parts: Mapping[str, Stateful], state: Mapping[str, NDArray[Any]], started: bool, check: Callable[[], None]
) -> None:
    """Bring parts into the state that `parts_state` returned. A refused state leaves them as they were.

    Args:
        parts: Parts by name.
        state: State of all of them.
        started: False if they have no state yet to go back to.
        check: Called when all are set; raises a ValueError if they do not fit together.

    Raises:
        ValueError: An entry is missing, or does not fit.
    """
    before = {name: piece.get_state() for name, piece in parts.items()} if started else {}
    try:
        for name, piece in parts.items():
            piece.set_state(part(state, name))
        check()
    except ValueError:
        for name, own in before.items():
            parts[name].set_state(own)
        raise


def heading(environment: str, configuration: Any, **more: Any) -> State:
    """Return the entries that say what a state belongs to."""
    settings = asdict(configuration) if is_dataclass(configuration) and not isinstance(configuration, type) else {}
    return {
        "format": np.array(FORMAT),
        "environment": np.array(environment),
        "configuration": np.array(json.dumps(settings | more, sort_keys=True, default=str)),
    }


def check_heading(state: Any, own: State) -> None:
    """Check that a state belongs to an environment with the heading `own`.

    Raises:
        ValueError: A state of another format, environment or configuration; the message names what differs.
    """
    if not isinstance(state, Mapping) or not own.keys() <= state.keys():
        raise ValueError(f"state must be what get_state() returned, got {type(state).__name__}")
    for name in ("format", "environment"):
        theirs, ours = np.asarray(state[name]).item(), own[name].item()
        if theirs != ours:
            raise ValueError(f"state is of {name} {theirs!r}, this is {ours!r}")
    try:
        theirs = json.loads(str(np.asarray(state["configuration"]).item()))
        items = dict(theirs)
    except (ValueError, TypeError) as error:
        raise ValueError(f"state's 'configuration' is damaged: {error}") from error
    ours = json.loads(own["configuration"].item())
    differing = [name for name in sorted({*items, *ours}) if items.get(name) != ours.get(name)]
    if differing:
        listed = ", ".join(f"{name}={items.get(name)!r} instead of {ours.get(name)!r}" for name in differing[:5])
        raise ValueError(f"state is of another configuration: {listed}; make the environment with the same arguments")


_WORD = 2**64


def generator_words(generators: Iterable[np.random.Generator]) -> NDArray[np.uint64]:
    """Return generators' states, shape (N, 6): high and low words of state and increment, and the half word kept."""
    words = []
    for generator in generators:
        state = generator.bit_generator.state
        if state["bit_generator"] != "PCG64":
            raise ValueError(f"np_random must be a PCG64, as Gymnasium makes it, got {state['bit_generator']}")
        inner = state["state"]
        words.append(
            [*divmod(inner["state"], _WORD), *divmod(inner["inc"], _WORD), state["has_uint32"], state["uinteger"]]
        )
    return np.array(words, np.uint64)


def generator_of(words: NDArray[np.uint64]) -> np.random.Generator:
    """Return a generator in the state of a row of `generator_words`.

    Raises:
        ValueError: No PCG64 has such a state.
    """
    high, low, inc_high, inc_low, kept, half = (int(word) for word in words)
    if kept > 1 or half >= 2**32 or inc_low % 2 == 0:
        raise ValueError(f"state's 'generator' must hold states of a PCG64, got {words.tolist()}")
    generator = np.random.Generator(np.random.PCG64())
    generator.bit_generator.state = {
        "bit_generator": "PCG64",
        "state": {"state": high * _WORD + low, "inc": inc_high * _WORD + inc_low},
        "has_uint32": kept,
        "uinteger": half,
    }
    return generator


class Resumable:
    """Environment whose exact state can be taken and set; the base of the single and the vector environments."""

    config: Any
    world: Any
    _started: bool

    def _parts(self) -> dict[str, Stateful]:
        """Parts of the environment that change, by their names in a state."""
        return {"world": self.world}

    def _running_rows(self) -> Mask:
        """Mask of the scenes whose episode is running, (N,)."""
        raise NotImplementedError

    def _row_generators(self) -> Sequence[np.random.Generator]:
        """Generators of the scenes' episodes, N."""
        raise NotImplementedError

    def _go_on(self, running: Mask, generators: list[np.random.Generator]) -> None:
        """Take over the flags and generators of a state; its parts have been set."""
        raise NotImplementedError

    def _check_running(self, running: Mask) -> None:
        """Refuse running episodes that have come to their last step: the tables of a world end there."""
        late = running & (self.world.steps >= self.world.episode_steps)
        if late.any():
            raise ValueError(
                f"state's 'running' must be False at the last step, got True in rows {np.flatnonzero(late)}"
            )

    def _heading(self) -> State:
        name = type(self).__name__.removesuffix("Env").removesuffix("Vector")
        return heading(name, self.config, engine=getattr(self, "engine", None))

    def get_state(self) -> State:
        """Return the exact state: copies from which `set_state` goes on to the bit, in another process too.

        Returns:
            Arrays by name, see `servotrack.envs.state`. They can be written with `numpy.savez`.

        Raises:
            gymnasium.error.ResetNeeded: Before the first reset.
        """
        if not self._started:
            raise ResetNeeded("there is no state yet: call reset() before get_state()")
        own = {"running": self._running_rows().copy(), "generator": generator_words(self._row_generators())}
        return self._heading() | own | parts_state(self._parts())

    def set_state(self, state: Mapping[str, NDArray[Any]]) -> None:
        """Go back to a state that `get_state` returned, here or in another environment with the same arguments.

        The next `step` and the resets that follow give what they gave there. Pictures start their trails anew.

        Args:
            state: Arrays by name; they are not changed. A vector environment gives the state of one scene, for example
                that of a single environment with the same arguments, to all its scenes.

        Raises:
            ValueError: The state belongs to another environment, configuration or engine, or is damaged.
        """
        check_heading(state, own := self._heading())
        count = self.world.count
        if count > 1 and len(entry(state, "running", (None,), np.bool_)) == 1:
            state = {name: value if name in own else np.repeat(value, count, axis=0) for name, value in state.items()}
        running, words = entry(state, "running", (count,), np.bool_), entry(state, "generator", (count, 6), np.uint64)
        generators = [generator_of(row) for row in words]
        set_parts(self._parts(), state, self._started, lambda: self._check_running(running))
        self._started = True
        self._go_on(running, generators)
