"""Refractive collinearity: from an object point through the water to the projection centre."""
