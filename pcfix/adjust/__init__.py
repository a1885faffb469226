"""Refractive bundle adjustment: poses, lens, points and the water from what the images measured."""
