"""Worlds of people in boxes: what rendered and recorded sequences share."""
