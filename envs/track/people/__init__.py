"""Tracking of people by boxes or centroids: the common part of rendered and recorded sequences."""
