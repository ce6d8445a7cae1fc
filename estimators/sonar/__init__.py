"""Passive sonar with a line array: beamforming, and tracking of bearings before detection."""
