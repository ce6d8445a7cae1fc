"""servotrack: servo what you cannot calibrate, track what you cannot count.

Importing this module registers the environments with Gymnasium and imports nothing heavier than Gymnasium itself.
"""

from servotrack._import_path import leave_working_directory

# Before Gymnasium, which imports NumPy: neither may come from the working directory.
leave_working_directory()

from servotrack._moved import install  # noqa: E402
from servotrack.envs.registration import register_all  # noqa: E402

__version__ = "0.1.0"
__all__ = ["__version__"]

install()
register_all()
