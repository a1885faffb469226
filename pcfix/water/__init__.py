"""The water surface: its height and normal above a place, its fit, and its refractive index."""
