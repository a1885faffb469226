"""Noise: which points of a cloud are none of the ground."""
