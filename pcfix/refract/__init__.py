"""Refraction itself: arrays in, arrays out."""
