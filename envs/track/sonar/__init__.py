"""Bearing-time records of a line array: the world of the sonar trackers."""
