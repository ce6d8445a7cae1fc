"""servotrack: servo what you cannot calibrate, track what you cannot count.

Importing this module registers the environments with Gymnasium and imports nothing heavier than Gymnasium itself.
"""

from servotrack._moved import install
from servotrack.envs.registration import register_all

__version__ = "0.1.0"
__all__ = ["__version__"]

install()
register_all()
