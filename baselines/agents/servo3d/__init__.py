"""Agents for serial arms: calibrated ones by image, pose or joint angles, and ones that know neither camera nor arm."""
