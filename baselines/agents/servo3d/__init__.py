"""Calibrated agents for serial arms: image-based, position-based, and with known joint angles of the goal."""
