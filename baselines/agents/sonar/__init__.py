"""Observers of bearing-time records: HMM and peak trackers behind `predict`."""
