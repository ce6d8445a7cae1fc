"""Readers of videos, image folders, and MOTChallenge and CAVIAR files."""
