"""servotrack: servo what you cannot calibrate, track what you cannot count.

Importing this module registers the environments with Gymnasium and imports nothing heavier than Gymnasium itself.
`track`, `Tracker`, `Tracks` and `write_tracks` track people in videos; they are imported when they are used.
"""

from typing import TYPE_CHECKING, Any

from servotrack._import_path import leave_working_directory

# Before Gymnasium, which imports NumPy: neither may come from the working directory.
leave_working_directory()

from servotrack._moved import install  # noqa: E402
from servotrack.envs.registration import register_all  # noqa: E402

__version__ = "0.2.0"
__all__ = ["Tracker", "Tracks", "__version__", "track", "write_tracks"]

if TYPE_CHECKING:
    from servotrack.baselines.track_command.api import Tracker, track
    from servotrack.baselines.track_command.people import Tracks, write_tracks

_LAZY = {"Tracker": "api", "track": "api", "Tracks": "people", "write_tracks": "people"}
"""Module of each name that is imported when it is used."""


def __getattr__(name: str) -> Any:
    if name not in _LAZY:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from importlib import import_module

    return getattr(import_module(f"servotrack.baselines.track_command.{_LAZY[name]}"), name)


install()
register_all()
